"""Controllers of a published model: which of them move together, and control paths on its clock."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from physworld.arrays import Array
from physworld.worldmodel.clock import clock_times, resample
from physworld.worldmodel.errors import ControlsInvalid
from physworld.worldmodel.model.graph import GraphSpec


def grip_groups(spec: GraphSpec, controllers: Array) -> tuple[Array, ...]:
    """Controllers (K, 3) that move as one grip, index arrays in the order of their first member.

    Control vertices of a grip hear each other in the graph; a controller that is no vertex goes with the nearest one.
    """
    n, count = spec.object_count, spec.control_count
    receiver, slot = np.nonzero((spec.neighbours[n:] >= n) & (spec.neighbours[n:] < spec.vertex_count))
    links = (receiver, spec.neighbours[n:][receiver, slot] - n)
    _, label = connected_components(
        coo_matrix((np.ones(len(receiver)), links), shape=(count, count)), directed=False
    )
    places = np.asarray(controllers, dtype=np.float64)
    gaps = np.linalg.norm(places[:, None] - places[spec.control_index][None], axis=2)
    owner = label[np.argmin(gaps, axis=1)]
    owner[spec.control_index] = label
    groups = [np.nonzero(owner == one)[0] for one in np.unique(label)]
    return tuple(sorted(groups, key=lambda group: int(group[0])))


def on_clock(controllers: Array, times: Array | None, dt_s: float, most_ticks: int) -> Array:
    """Control paths interpolated linearly at the ticks of a clock, (B, ticks, K, 3) [m].

    Args:
        controllers: paths of B candidates (B, T, K, 3) [m].
        times: at which they are known (T,) [s], from 0; None where they are at ticks already.
        dt_s: between two ticks [s].
        most_ticks: how far the times may go.

    Raises:
        ControlsInvalid: as many times as places are asked for, finite, increasing from 0 and not beyond
            ``most_ticks``.
    """
    if times is None:
        return controllers
    times = np.asarray(times, dtype=np.float64)
    if len(times) != controllers.shape[1]:
        raise ControlsInvalid(
            f"{len(times)} times for {controllers.shape[1]} places of the controllers", "times"
        )
    if not np.isfinite(times).all() or abs(times[0]) > 1e-9 or np.any(np.diff(times) <= 0.0):
        raise ControlsInvalid("times must start at 0, be finite and increase strictly", "times")
    if times[-1] > most_ticks * dt_s:
        raise ControlsInvalid(
            f"times end at {times[-1]:.4g} s; {most_ticks} ticks of {dt_s:.4g} s are the most for "
            f"{len(controllers)} candidates",
            "times",
        )
    ticks = clock_times(float(times[-1]), dt_s)
    return np.moveaxis(resample(np.moveaxis(controllers, 1, 0), times, ticks), 0, 1)


def peak_speed(controllers: Array, dt_s: float) -> float:
    """Largest speed [m/s] of any controller of (…, T, K, 3)."""
    moves = np.linalg.norm(np.diff(controllers, axis=-3), axis=-1)
    return float(moves.max(initial=0.0)) / dt_s
