"""Substeps that are recorded once and replayed: what a run launches instead of its kernels one by one."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

CHUNK = 8  # substeps that are launched together; every interval between frames has a multiple of it
_RECORDED_ON_CPU = (
    2  # a replay there costs no more than a microsecond, a recorded launch a third of a millisecond
)


class Chunk:
    """:data:`CHUNK` substeps, recorded when this is made.

    Args:
        substep: launches the kernels of one substep; always the same ones on the same arrays.
        device: Warp device of all of them.
    """

    def __init__(self, substep: Callable[[], None], device: str) -> None:
        recorded = CHUNK if wp.get_device(device).is_cuda else _RECORDED_ON_CPU
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(recorded):
                substep()
        self._graph, self._replays = capture.graph, CHUNK // recorded

    def launch(self) -> None:
        """Go :data:`CHUNK` substeps on."""
        for _ in range(self._replays):
            wp.capture_launch(self._graph)
