"""Frames to an MP4 film (H.264), in memory."""

from __future__ import annotations

import io
from collections.abc import Iterable
from fractions import Fraction

import av
import numpy as np

from physworld.arrays import Array


def encode_mp4(frames: Iterable[Array], fps: float) -> bytes:
    """A film of frames (H, W, 3), in [0, 1] or 8 bit; an odd row or column at the edge is left out, as H.264 needs.

    Raises:
        ValueError: no frame, frames of different shapes, or a rate that is not positive.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"a film's rate must be positive, got {fps} frames a second")
    buffer = io.BytesIO()
    shape: tuple[int, ...] | None = None
    with av.open(buffer, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            picture = np.asarray(frame)
            if shape is None:
                shape = picture.shape
                if picture.ndim != 3 or picture.shape[2] != 3 or min(picture.shape[:2]) < 2:
                    raise ValueError(f"a frame must be of shape (H, W, 3), got {picture.shape}")
                stream.height, stream.width = (size - size % 2 for size in picture.shape[:2])
            if picture.shape != shape:
                raise ValueError(f"frame {number} has shape {picture.shape}, the first one {shape}")
            if picture.dtype != np.uint8:
                picture = np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)
            picture = np.ascontiguousarray(picture[: stream.height, : stream.width])
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if shape is None:
            raise ValueError("a film needs at least one frame")
        film.mux(stream.encode())
    return buffer.getvalue()


def frames_per_second(times: Array) -> float:
    """The rate of frames at ``times`` (T,) [s]: one over their median distance.

    Raises:
        ValueError: fewer than 2 frames or times that do not rise.
    """
    steps = np.diff(np.asarray(times, dtype=np.float64))
    if not len(steps) or not (steps > 0).all():
        raise ValueError(f"a film's {len(times)} times must be at least 2 and rise")
    return float(1.0 / np.median(steps))
