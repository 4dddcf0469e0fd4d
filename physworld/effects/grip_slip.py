"""A grip that gives: held material hangs on a damped spring instead of being prescribed.

    F = (path - x) / C + 2 zeta sqrt(M / C) (dpath/dt - v)        C compliance [m/N], M the mass that the grip holds

The spring is spread over the held nodes by their mass, so all of a grip have one frequency 1/sqrt(C M) and a pad of
rubber turns as well as shifts. With several grips every one has the compliance C, whatever it holds. The smaller C, the
smaller the time step: below the probe the grip is stiffer than the body's own fastest mode and shows nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.effects.base import Calibrated, Effect, Strength
from physworld.effects.places import gravity_size, held_count
from physworld.engine.problem import HeldNodes, Problem, nodal_mass
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.node_kernels import on_path
from physworld.engine.updated.grips import particle_grips
from physworld.engine.updated.terms import ParticleBody
from physworld.materials.rod import RodLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


_STEP = 0.25  # of a sheared rope's compliance
_SOFT = 1 / 200  # cells: softer grips are no small change from springs on nodes that are all held


@wp.kernel
def pull_of_grip(
    # model
    nodes: wp.array[wp.int32],
    stiffness: wp.array[wp.float64],
    friction: wp.array[wp.float64],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Pull one held node towards its path."""
    held = wp.tid()
    node = nodes[held]
    substeps = wp.float64(counter[2])
    s = wp.float64(counter[1]) / substeps
    for i in range(3):
        k = 3 * held + i
        here = on_path(path_x, path_v, counter[0], k, s, clock[0])
        next = on_path(path_x, path_v, counter[0], k, s + wp.float64(1.0) / substeps, clock[0])
        speed = (next - here) * clock[1]
        force[3 * node + i] += stiffness[held] * (here - x[3 * node + i])
        force[3 * node + i] += friction[held] * (speed - v[3 * node + i])


@dataclass(frozen=True)
class GripSprings:
    """Term of :class:`GripSlip`: the nodes that were held, and their paths; what each grip holds at the start.

    ``grips``: places of their nodes [m], (n, 3) each: what is held belongs to the grip that has the nearest.
    """

    held: HeldNodes
    grips: tuple[Array, ...]
    compliance_m_n: float
    damping_ratio: float

    def bind(self, problem: Problem) -> BoundGripSprings:
        """Device arrays."""
        return self._bound(problem, problem.nodal_mass(), self.held)

    def on_particles(self, body: ParticleBody) -> BoundGripSprings:
        """Device arrays for the gripped particles in the place of held nodes."""
        held, lattice = self.held, body.problem.lattice
        grips = particle_grips(lattice, body.solid, held.nodes, held.positions, held.velocities)
        gripped = HeldNodes(grips.particles, grips.positions, grips.velocities)
        return self._bound(body.problem, body.mass, gripped)

    def _bound(self, problem: Problem, masses: Array, held: HeldNodes) -> BoundGripSprings:
        device, frames = problem.device, len(held.positions)
        mass = masses[held.nodes]
        gaps = np.stack([cKDTree(places).query(held.positions[0])[0] for places in self.grips])
        owner = np.argmin(gaps, axis=0)
        of_grip = np.bincount(owner, weights=mass, minlength=len(self.grips))[owner]
        frequency = 1.0 / np.sqrt(self.compliance_m_n * of_grip)
        rate = 2 * self.damping_ratio * frequency
        inputs = [
            wp.array(held.nodes, dtype=wp.int32, device=device),
            wp.array(mass * frequency**2, dtype=wp.float64, device=device),
            wp.array(mass * rate, dtype=wp.float64, device=device),
            wp.array(held.positions.reshape(frames, -1), dtype=wp.float64, device=device),
            wp.array(held.velocities.reshape(frames, -1), dtype=wp.float64, device=device),
        ]
        return BoundGripSprings(inputs, device, float(frequency.max()), float(rate.max()))


@dataclass(frozen=True)
class BoundGripSprings(BoundTerm):
    """Springs on the device."""

    inputs: list[Any]
    device: str
    frequency_rad_s: float
    friction_per_s: float

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the pulls [N]."""
        inputs = [*self.inputs, clock, counter, x, v]
        wp.launch(pull_of_grip, dim=len(self.inputs[0]), inputs=inputs, outputs=[force], device=self.device)


@dataclass(frozen=True)
class GripSlip(Effect):
    """``compliance_m_n``: C of a grip [m/N]; ``damping_ratio``: zeta of the grip with its mass alone."""

    name = "grip_slip"
    title = "grip that gives"
    equation = "F = (path - x) / C + 2 zeta sqrt(M / C) (dpath/dt - v)"
    kind = "boundary"
    gates = ("compliance_m_n",)

    compliance_m_n: float = 0.0
    damping_ratio: float = 0.5

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to giving way a tenth of the size under the weight; the probe is a spring as fast as a cell."""
        weight = float(twin.particle_mass.sum()) * gravity_size(twin)
        mass = nodal_mass(twin.lattice, twin.law, None)
        lightest = min((float(mass[nodes].sum()) for nodes in twin.held_nodes if len(nodes)), default=0.0)
        rate = twin.law.wave_speed_m_s / float(twin.lattice.spacing.min())
        probe = 4.0 / (rate**2 * max(lightest, 1e-12))
        high = max(0.1 * float(np.ptp(twin.particles_start, axis=0).max()) / weight, 10.0 * probe)
        return (
            Strength("compliance_m_n", "m/N", 0.0, high, probe),
            Strength("damping_ratio", "1", 0.0, 2.0, 0.1, gate=False, start=0.5),
        )

    @classmethod
    def calibrated(cls, twin: Twin) -> Calibrated | None:
        """How far a rope's grips give, up to what its shear does there.

        Rods here do not shear. One that does is displaced by a sideways force F next to a grip by
        F sqrt(B/T) / (k G A): under the tension T it shears over the length sqrt(B/T) along which it bends
        (Timoshenko 1921; B = E I, and k G A is about 0.3 E A of a round section). That is a compliance of
        r^2 / (1.2 sqrt(B T)), with the rope's weight for T. A search starts at a quarter of it: a grip that is
        nearly rigid is so for every small change.
        """
        if not isinstance(twin.law, RodLaw) or cls.refuses(twin) is not None:
            return None
        weight = float(twin.particle_mass.sum()) * gravity_size(twin)
        sheared = twin.body.thickness_m**2 / (1.2 * float(np.sqrt(twin.law.bending_n_m2 * weight)))
        known = next(s for s in cls.strengths(twin) if s.name == "compliance_m_n")
        step = _STEP * sheared
        return Calibrated(replace(known, high=sheared), step, sheared, start=step)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A body that nobody holds, or that is held softly already."""
        held = held_count(twin)
        if held == 0:
            return f"{held} nodes are held: no grip that could give"
        if twin.openings:
            return f"{sum(one is not None for one in twin.openings)} of the grips let go"
        if twin.grip_softness > _SOFT:
            return f"the grips take hold over {twin.grip_softness:.2g} cells already"
        return None

    def attach(self, problem: Problem, held: HeldNodes, twin: Twin) -> tuple[Problem, HeldNodes]:
        """Frees the held nodes and pulls them instead."""
        grips = tuple(twin.body.start[nodes] for nodes in twin.held_nodes if len(nodes))
        term = GripSprings(held, grips, self.compliance_m_n, self.damping_ratio)
        empty = np.empty((len(held.positions), 0, 3))
        free = HeldNodes(np.empty(0, dtype=int), empty, empty)
        return replace(problem, terms=(*problem.terms, term)), free
