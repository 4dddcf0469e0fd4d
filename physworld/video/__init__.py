"""Pictures of a motion: 3D Gaussians that vertices carry, rendered to frames and film, compared with given frames."""

from physworld.camera import Camera, look_at, orbit_view
from physworld.video.drawing import Drawing, checked_motion, eight_bit, whole_motion_view
from physworld.video.film import FrameScores, compare_frames, encode_mp4, frames_per_second
from physworld.video.gaussians import Gaussians, from_ply, gaussians_at_points, to_ply
from physworld.video.moving import GaussianCarrier
from physworld.video.render import Renderer
from physworld.video.splat_fit import FittedSplat, SplatConfig, fit_splat
from physworld.video.splat_start import SplatView, surface_of

__all__ = [
    "Camera",
    "Drawing",
    "FittedSplat",
    "FrameScores",
    "GaussianCarrier",
    "Gaussians",
    "Renderer",
    "SplatConfig",
    "SplatView",
    "checked_motion",
    "compare_frames",
    "eight_bit",
    "encode_mp4",
    "fit_splat",
    "frames_per_second",
    "from_ply",
    "gaussians_at_points",
    "look_at",
    "orbit_view",
    "surface_of",
    "to_ply",
    "whole_motion_view",
]
