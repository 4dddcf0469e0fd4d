"""Gradients of tracked points: what a calibration or a trace asks of a twin's run.

    run = TwinRun(twin, ...);  fields, scalars = run.gradient(dL/dtracks, {"E": parameter(twin, "youngs_modulus_pa")})

The points follow the nodes linearly but for a sheet's normal and a rod's turning frame, which are differentiated by
central differences of a few numbers a point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from physworld.arrays import Array
from physworld.engine.gradients.adjoint import MEMORY_MB, Adjoint
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.gradients.gradient import Direction, gradients
from physworld.errors import NotDifferentiable
from physworld.geometry.rigid import least_rotation
from physworld.twin.integration import Integration
from physworld.twin.twin import Twin

_STEP = 1e-3  # relative change of a parameter between its two neighbours
_PROBE_STEP = 0.02  # of a strength, in its probes or in itself: forces of solids are single precision
_SLOPE_STEP = 1e-6


@dataclass(frozen=True)
class Neighbours:
    """Two twins that differ by ``width`` of a scalar."""

    high: Twin
    low: Twin
    width: float


def parameter(twin: Twin, name: str) -> Neighbours:
    """Neighbours by one of :attr:`Twin.parameters`; one-sided from zero."""
    value = twin.parameters[name]
    step = _STEP * abs(value) if value else _STEP
    low = max(value - step, 0.0) if value >= 0 else value - step
    return Neighbours(
        twin.with_parameters(**{name: value + step}), twin.with_parameters(**{name: low}), value + step - low
    )


def strength(twin: Twin, effect: str, name: str) -> Neighbours:
    """Neighbours by a strength of one of the twin's effects; one-sided at the bounds of the strength.

    Raises:
        KeyError: the twin has no such effect, or it has no such strength.
    """
    known = {e.name: e for e in twin.effects}[effect]
    facts = {s.name: s for s in known.strengths(twin)}[name]
    value = known.values[name]
    value = 0.0 if value is None else value
    step = _PROBE_STEP * max(abs(value), abs(facts.probe))
    high, low = min(value + step, facts.high), max(value - step, facts.low)
    return Neighbours(
        twin.with_effect(replace(known, **{name: high})),
        twin.with_effect(replace(known, **{name: low})),
        high - low,
    )


class TwinRun:
    """A run of a twin that can be differentiated.

    Attributes:
        nodes: (T, n, 3) [m] at the frames.
        tracks: tracked points (T, N, 3) [m], as the camera reports them.
        time_step_s: largest substep [s].
    """

    def __init__(
        self,
        twin: Twin,
        control_times: Array,
        control_points: Array,
        frame_times: Array,
        *,
        properties: Array | None = None,
        time_step_s: float | None = None,
        memory_mb: float = MEMORY_MB,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Integrate: arguments and errors of :meth:`Twin.simulate_nodes`, and those of :class:`Adjoint`.

        Raises:
            NotDifferentiable: also for a twin of the updated Lagrangian form, or a mesh of triangles.
        """
        if not twin.lattice.smooth:
            raise NotDifferentiable(f"{twin.lattice.title} has no gradient: fit by simulations alone")
        if not twin.form.supports("gradients"):
            raise NotDifferentiable(
                "a run of the updated Lagrangian form has no gradient: fit by simulations alone"
            )
        if twin.openings:
            raise NotDifferentiable("a run whose grips let go has no gradient: fit by simulations alone")
        self._twin, self._times = twin, frame_times
        self._drive = control_times, control_points, frame_times, properties
        self._integration = self._setting(twin)
        adjoint = Adjoint(self._integration.problem, time_step_s, memory_mb)
        self.time_step_s = adjoint.time_step_s
        self.recorded = adjoint.run(
            twin.body.start,
            self._integration.velocity,
            self._integration.held,
            self._integration.knots,
            progress,
        )
        self.nodes = self._integration.at_frames(twin.body.start, self.recorded.nodes)
        self.tracks = twin.observe(self.nodes, frame_times)

    def _setting(self, twin: Twin) -> Integration:
        """A twin under the run's controls."""
        times, points, frames, properties = self._drive
        return twin.integration(times, points, frames, properties=properties)

    def gradient(
        self, tracks_bar: Array, scalars: Mapping[str, Neighbours] | None = None
    ) -> tuple[Gradient, dict[str, float]]:
        """Derivatives of L from those by the tracked points, (T, N, 3): fields, and one for each scalar.

        A measurement effect that is active is passed by: L is differentiated as if the points were seen as they are,
        but for the scalars, whose own share of the measurement counts.

        Raises:
            NotDifferentiable: a term or a scalar has no derivative.
        """
        scalars = scalars or {}
        index = self._integration.frame_index
        seed = np.zeros_like(self.recorded.nodes)
        np.add.at(seed, index[index >= 0], nodes_bar(self._twin, self.nodes, tracks_bar)[index >= 0])
        directions = {
            name: Direction(self._setting(pair.high), self._setting(pair.low), pair.width)
            for name, pair in scalars.items()
        }
        fields, found = gradients(self.recorded, seed, directions)
        for name, pair in scalars.items():
            seen = [side.observe(self.nodes, self._times) for side in (pair.high, pair.low)]
            found[name] += float(np.sum(tracks_bar * (seen[0] - seen[1]))) / pair.width
        return fields, found


def nodes_bar(twin: Twin, nodes: Array, tracks_bar: Array) -> Array:
    """Derivatives by the nodes (T, n, 3) from those by the tracked points (T, N, 3), at ``nodes``."""
    body, lattice = twin.body, twin.lattice
    found = _transposed(lattice.interpolation(body.points), tracks_bar)
    if lattice.dim == 3 or not np.any(body.offsets):
        return found
    orders = [(1, 0), (0, 1)] if lattice.dim == 2 else [(1,)]
    rows = [lattice.interpolation(body.points, order) for order in orders]
    slopes = [_apply(row, nodes) for row in rows]
    start = rows[0] @ body.start

    def shifted() -> Array:
        if lattice.dim == 2:
            normal = np.cross(slopes[0], slopes[1])
            off: Array = body.offsets * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        else:
            off = np.einsum("tnij,nj->tni", least_rotation(start[None], slopes[0]), body.offsets)
        return off

    for row, slope in zip(rows, slopes, strict=True):
        bar = np.empty_like(slope)
        for axis in range(3):
            slope[..., axis] += _SLOPE_STEP
            high = shifted()
            slope[..., axis] -= 2 * _SLOPE_STEP
            bar[..., axis] = np.sum(tracks_bar * (high - shifted()), axis=-1) / (2 * _SLOPE_STEP)
            slope[..., axis] += _SLOPE_STEP
        found += _transposed(row, bar)
    return found


def _apply(row: sparse.csr_matrix, nodes: Array) -> Array:
    return np.stack([row @ frame for frame in nodes])


def _transposed(row: sparse.csr_matrix, values: Array) -> Array:
    return np.stack([row.T @ frame for frame in values])
