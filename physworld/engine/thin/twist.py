"""Twist of a rope that is held at two or more places: quasi-static, uniform in each span between two grips.

    E = Theta^2 / (2 C)        C = sum over the span of ds / GJ        moment M = Theta / C

Theta is the angle from the material frame that the first grip prescribes, carried along the centre line without twist
(the Bishop frame), to the frame that the second prescribes. Twist waves run so much faster than bending ones that the
material frame is in equilibrium at all times (the quasi-static frame of Bergou et al. 2008): then its moment is the
same all along an isotropic, naturally straight rod, and nothing but the two ends and the centre line's shape (its
holonomy) sets it. The twist of a span is not a state: it has no mass and adds no mode. A free end carries none.

Angles are followed from substep to substep, so turns add up beyond 2 pi. They start within half a turn.
Not carried: internal friction of twist, an unround section, a rest shape with twist in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.terms.term import BoundTerm
from physworld.engine.thin.twist_kernels import push_twisted, sum_turning, turn_spans
from physworld.errors import TwistLost

if TYPE_CHECKING:
    from physworld.engine.problem import Problem

_FOLD = 0.02  # 1 + cosine of the angle between neighbouring tangents below which a turn is lost: 168 degrees
_MOST_TURN_RAD = 0.75 * np.pi  # of a grip between two frames: beyond pi the sense of a turn cannot be told
_MOST_BEND_RAD = 4 * np.pi  # of a span, for the time step


@dataclass(frozen=True, eq=False)
class Span:
    """A piece of rope between two grips that hold its section.

    Attributes:
        particles: of the lattice, in the order of the arc length, (M,).
        frames: tangent and director (unit, across it) that the grips prescribe at the low and the high end, at the
            frames, (T, 2, 2, 3): end, then tangent and director.
        rates: their rates [1/s], likewise.
    """

    particles: Array
    frames: Array
    rates: Array


def span_between(
    lattice: Lattice, start: Array, ends_m: tuple[float, float], turns: Array, times: Array
) -> Span | None:
    """The span between two grips of a rope that is not twisted at ``start``.

    Args:
        lattice: of the rope.
        start: nodal positions at the pose from which the grips' turns count [m], (n, 3).
        ends_m: arc lengths at which the low grip ends and the high one begins [m].
        turns: rotations of both grips at the frames, (2, T, 3, 3).
        times: of the frames [s], (T,).

    Returns:
        None where no material lies between the grips.
    """
    places = lattice.particle_coordinates[:, 0]
    inside = (places > ends_m[0]) & (places < ends_m[1]) & (lattice.particle_measures > 0)
    particles = np.flatnonzero(inside)
    if len(particles) == 0:
        return None
    particles = particles[np.argsort(places[particles])]
    coordinates = np.array([ends_m[0], *places[particles], ends_m[1]])
    slopes = lattice.interpolation(coordinates[:, None], (1,)) @ start
    tangents = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    low = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    low /= np.linalg.norm(low)
    high = carried(low, tangents)
    pairs = np.array([[tangents[0], low], [tangents[-1], high]])
    frames = np.einsum("etij,ekj->teki", turns, pairs)
    rates = np.gradient(frames, times, axis=0, edge_order=2 if len(times) > 2 else 1)
    return Span(particles, frames, rates)


def carried(director: Array, tangents: Array) -> Array:
    """``director`` (3,) carried along unit ``tangents`` (M, 3) without twist: across the last of them."""
    for t, u in pairwise(tangents):
        axis = np.cross(t, u)
        first = np.cross(axis, director)
        director = director + first + np.cross(axis, first) / (1.0 + t @ u)
    return director


@dataclass(frozen=True, eq=False)
class Twist:
    """Twist of the ``spans`` of one rope, as a term."""

    spans: tuple[Span, ...]

    def bind(self, problem: Problem) -> BoundTwist:
        """Device arrays for one problem; raises ValueError for a body that is no rod."""
        return BoundTwist(self.spans, problem)


class BoundTwist(BoundTerm):
    """Twist on a device.

    Attributes:
        spans: how many.
        shares: part of every particle in the compliance of each span, (S, P): with it a derivative by the moment's
            logarithm is one by the particles' stiffness.
    """

    def __init__(self, spans: tuple[Span, ...], problem: Problem) -> None:
        lattice, law, device = problem.lattice, problem.law, problem.device
        if law.torsion_n_m2 <= 0:
            raise ValueError(f"twist needs a rod with a torsional stiffness, got {law}")
        self.spans, self.device = len(spans), device
        measure = lattice.particle_measures.copy()
        if problem.stiffness_factor is not None:
            measure = measure / problem.stiffness_factor
        particles = np.concatenate([span.particles for span in spans])
        begins = np.concatenate([[0], np.cumsum([len(span.particles) for span in spans])])
        compliance = np.array([measure[span.particles].sum() for span in spans]) / law.torsion_n_m2
        self.shares = np.zeros((len(spans), lattice.fill.size))
        for row, span in zip(self.shares, spans, strict=True):
            row[span.particles] = measure[span.particles] / measure[span.particles].sum()
        cell, lane = np.divmod(particles, lattice.fill.shape[1])
        nodes, slopes = lattice.cell_nodes[cell], (lattice.table((1,)) / lattice.spacing[0]).T[lane]
        self._turns = np.stack([prescribed_turns(span) for span in spans])
        self.frequency_rad_s = _fastest(problem.nodal_mass(), nodes, slopes, spans, compliance)

        def array(values: Array, dtype: type = wp.float64) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        frames = [len(spans[0].frames), -1]
        self.begins, self.compliance = array(begins, wp.int32), array(compliance)
        self.rows = [array(nodes, wp.int32), array(slopes)]
        self.span_of = array(np.repeat(np.arange(len(spans)), np.diff(begins)), wp.int32)
        self._paths = [
            array(np.stack([span.frames for span in spans], axis=1).reshape(frames)),
            array(np.stack([span.rates for span in spans], axis=1).reshape(frames)),
        ]
        self.angle = wp.zeros(len(spans), dtype=wp.float64, device=device)
        self.state = _State(len(spans), len(particles), device)
        self.memory = (self.angle,)

    @property
    def angles_rad(self) -> Array:
        """Twist of every span in the last substep [rad], (S,)."""
        angles: Array = self.angle.numpy().copy()
        return angles

    @property
    def moments_n_m(self) -> Array:
        """Twisting moment of every span in the last substep [N m], (S,)."""
        moments: Array = self.state.moment.numpy().copy()
        return moments

    def begin(self, times: Array) -> None:
        """A run starts.

        Raises:
            TwistLost: a grip turns too far from one frame to the next.
        """
        steps = np.abs(np.diff(self._turns, axis=2))
        if steps.max(initial=0.0) > _MOST_TURN_RAD:
            frame = int(np.argmax(steps.max(axis=(0, 1))))
            raise TwistLost(
                f"a grip turns the rope's end by {steps.max():.2f} rad between frames {frame} and {frame + 1}; beyond "
                f"{_MOST_TURN_RAD:.2f} rad the sense of a turn cannot be told (sample the controllers faster)"
            )

    def check(self, time_s: float) -> None:
        """After a frame.

        Raises:
            TwistLost: the rope folded back on itself between two particles, where turns are lost.
        """
        narrow = float(self.state.narrow.numpy().min())
        if not narrow >= _FOLD:
            angle = np.degrees(np.arccos(np.clip(narrow - 1.0, -1.0, 1.0)))
            raise TwistLost(
                f"the rope folded by {angle:.0f} degrees between two neighbouring particles before t = {time_s:.4f} s; "
                f"twist cannot be followed beyond {np.degrees(np.arccos(_FOLD - 1.0)):.0f} degrees (take finer cells)"
            )

    def turn(self, x: wp.array, clock: wp.array, counter: wp.array) -> None:
        """Find angles, moments and unit tangents at nodal positions ``x`` (3n,)."""
        state = self.state
        wp.launch(
            turn_spans, dim=self.spans,
            inputs=[self.begins, *self.rows, self.compliance, *self._paths, clock, counter, x],
            outputs=[self.angle, state.narrow, state.along, state.inverse, state.ends, state.moment],
            device=self.device,
        )  # fmt: skip

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces of twist [N] at nodal positions ``x`` (3n,) to ``force``.

        Args:
            x, v, clock, counter, force: as in :meth:`BoundTerm.launch`.
        """
        self.turn(x, clock, counter)
        wp.launch(
            push_twisted, dim=len(self.span_of),
            inputs=[self.begins, self.span_of, *self.rows, *self.state.geometry, self.state.moment],
            outputs=[force], device=self.device,
        )  # fmt: skip


class TwistMeter:
    """Energy of a bound twist and the work that grips do by turning sections, for the ledger.

    Args:
        twist: launched before every :meth:`add`.
        frames: how many are written.
    """

    def __init__(self, twist: BoundTwist, frames: int) -> None:
        spans, device = twist.spans, twist.device

        def zeros(shape: object, dtype: type = wp.float64) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self._twist = twist
        self._last = [zeros(4 * spans, wp.vec3d), zeros(2 * spans, wp.vec3d), zeros(spans), zeros(spans)]
        self._out = [zeros((frames, spans)), zeros((frames, spans))]

    def add(self, counter: wp.array) -> None:
        """One substep."""
        twist, state = self._twist, self._twist.state
        wp.launch(
            sum_turning, dim=twist.spans,
            inputs=[twist.begins, counter, state.along, state.ends, twist.angle, state.moment, *self._last],
            outputs=self._out, device=twist.device,
        )  # fmt: skip

    def read(self) -> tuple[Array, Array]:
        """Work of the turning grips since the start and stored energy at the frames [J], (frames,) each."""
        work, energy = (array.numpy().sum(axis=1) for array in self._out)
        return work, energy


class _State:
    """What one substep finds: nothing of it is remembered but what :attr:`BoundTwist.angle` holds."""

    def __init__(self, spans: int, points: int, device: str) -> None:
        self.along = wp.zeros(points, dtype=wp.vec3d, device=device)
        self.inverse = wp.zeros(points, dtype=wp.float64, device=device)
        self.ends = wp.zeros(4 * spans, dtype=wp.vec3d, device=device)
        self.moment = wp.zeros(spans, dtype=wp.float64, device=device)
        self.narrow = wp.full(spans, 2.0, dtype=wp.float64, device=device)

    @property
    def geometry(self) -> list[wp.array]:
        """Unit tangents, 1 / |x'|, and the ends' frames."""
        return [self.along, self.inverse, self.ends]


def _fastest(mass: Array, nodes: Array, slopes: Array, spans: tuple[Span, ...], compliance: Array) -> float:
    """Bound on the fastest frequency [rad/s] that twist adds.

    The Hessian of the energy by unit tangents is M d2Theta + dTheta dTheta' / C. Neighbours couple with half of M, so
    the first is at most M; the second at most the sum of (bend between neighbours)^2 / C of a span that is bent evenly
    by two turns. M is that of the grips' turns in the run and one more of the centre line. From tangents to nodes by
    Gershgorin's bound for the lumped mass.
    """
    rows = np.zeros((len(nodes), len(mass)))
    rows[np.arange(len(nodes))[:, None], nodes] = slopes
    per_mass = float((np.abs(rows.T @ rows).sum(axis=1) / mass).max())
    worst = 0.0
    for span, soft in zip(spans, compliance, strict=True):
        low, high = prescribed_turns(span)
        turned = np.abs(high - low).max() + 2 * np.pi
        worst = max(worst, turned / soft + _MOST_BEND_RAD**2 / (len(span.particles) * soft))
    return float(np.sqrt(per_mass * worst))


def prescribed_turns(span: Span) -> Array:
    """Angles by which the grips turned about their tangents since the first frame [rad], low end then high, (2, T)."""
    turned = np.zeros((2, len(span.frames)))
    for end in range(2):
        for frame in range(1, len(span.frames)):
            (t, m), (u, goal) = span.frames[frame - 1, end], span.frames[frame, end]
            m = carried(m, np.array([t, u])) if t @ u > -1.0 + 1e-9 else m
            turned[end, frame] = np.arctan2(np.cross(m, goal) @ u, m @ goal)
    return np.cumsum(turned, axis=1)
