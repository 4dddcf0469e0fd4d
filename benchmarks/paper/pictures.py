"""Films of predictions beside the recording that they predict: PSNR, SSIM, LPIPS and IoU.

The splat is fitted to the first frame. Every prediction carries it by the same tracked points, so that films differ by
motion alone. Compared is the object in front of white, in one box for all frames that holds it with a margin; where the
gripper or what passes by hides it, both pictures are white and nothing counts as covered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from benchmarks.paper.recordings import Recording
from physworld.arrays import Array
from physworld.camera import Camera
from physworld.video import (
    GaussianCarrier,
    Gaussians,
    Renderer,
    SplatConfig,
    compare_frames,
    fit_splat,
)
from physworld.video.film import NOT_MEASURED

MARGIN_PX = 16
SCORES = ("psnr_db", "ssim", "lpips", "iou")
Distance = Callable[[Array, Array], float]


@dataclass(frozen=True)
class Filmed:
    """A recording with the splat of its first frame."""

    recording: Recording
    splat: Gaussians

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns that hold the object in every picture, with a margin."""
        shown = (self.recording.seen == 0).any(axis=0)
        spans = []
        for axis, size in ((1, shown.shape[0]), (0, shown.shape[1])):
            at = np.flatnonzero(shown.any(axis=axis))
            spans.append(slice(max(int(at[0]) - MARGIN_PX, 0), min(int(at[-1]) + 1 + MARGIN_PX, size)))
        return spans[0], spans[1]

    @cached_property
    def camera(self) -> Camera:
        """The camera of that box alone."""
        whole, (rows, columns) = self.recording.camera, self.box
        return replace(
            whole,
            width=columns.stop - columns.start,
            height=rows.stop - rows.start,
            cx=whole.cx - columns.start,
            cy=whole.cy - rows.start,
        )

    def given(self, frames: Sequence[int]) -> tuple[Array, Array]:
        """The object in front of white (F, h, w, 3) in [0, 1], and its pixels (F, h, w) bool."""
        rows = [self.recording.at(frame) for frame in frames]
        masks = self.recording.seen[rows][:, *self.box] == 0
        pictures = self.recording.pictures[rows][:, *self.box] / 255.0
        return np.where(masks[..., None], pictures, 1.0), masks

    def film(self, tracks: Array, frames: Sequence[int]) -> tuple[Array, Array]:
        """Pictures (F, h, w, 3) in [0, 1] and coverage (F, h, w) of a prediction.

        Args:
            tracks: of the tracked points, (T, N, 3) [m].
            frames: which have a picture.
        """
        carrier = GaussianCarrier(self.splat, self.recording.scene.points[0])
        renderer = Renderer(self.camera)
        pictures, coverage = [], []
        for frame in frames:
            shown = renderer.render(*carrier.at(tracks[frame]))
            hidden = self.recording.seen[self.recording.at(frame)][self.box] > 0
            pictures.append(np.where(hidden[..., None], 1.0, shown.rgb))
            coverage.append(np.where(hidden, 0.0, shown.alpha))
        return np.stack(pictures), np.stack(coverage)

    def compared(
        self, tracks: Array, frames: Sequence[int], lpips: Distance | None = None
    ) -> dict[str, float | None]:
        """The scores of a prediction's film, means over frames; LPIPS is None without its network.

        Args:
            tracks: of the tracked points, (T, N, 3) [m].
            frames: which are compared.
            lpips: distance of two pictures.
        """
        pictures, coverage = self.film(tracks, frames)
        given, masks = self.given(frames)
        found = compare_frames(pictures, given, coverage, masks, lpips)
        scores = {name: getattr(found, name) for name in SCORES}
        return {name: None if value == NOT_MEASURED else float(value) for name, value in scores.items()}


def splat_of(recording: Recording, config: SplatConfig) -> Gaussians:
    """The splat of the first frame, of the object's own pixels in all cameras with their measured depth."""
    return fit_splat(list(recording.views), config=config).gaussians
