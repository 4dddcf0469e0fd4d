"""Energy ledger of a run in the updated Lagrangian form: where every joule went, and what the transfers lost.

    lost = - (change of kinetic + gravitational + elastic energy)
           + work of grips, contacts and terms - taken by drag - dissipated

Works are summed substep by substep on the grid, where forces act; stored energies are the particles'. Two of the parts
are measured apart as well. ``transfers`` is the kinetic energy that goes missing from particles to grid and back: the
damping of the scheme. ``dissipated`` is the work of the stresses less what the law stores: plastic flow and internal
friction; of an elastic body without friction it is the error of the time step and of F, which is integrated along the
motion. Particles move by the velocity after a kick, not by the mean, so a fall is out of balance by dt over its time.

The metered run keeps the stresses' impulse apart on the grid, which is the same motion to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes
from physworld.engine.updated.energy_kernels import sum_grid_works, sum_kinetic

if TYPE_CHECKING:
    from physworld.engine.updated.formulation import UpdatedLagrangian
    from physworld.engine.updated.run import ParticleRun

_STRESS, _, _DRAG, _GRIPS, _CONTACTS, _STOPPED, _GRID_BEFORE, _GRID_AFTER, _BEGIN, _KICKED, _BACK, _END = (
    range(12)
)


@dataclass(frozen=True)
class ParticleLedger:
    """Energies at every frame [J], all (T,); works and losses are sums since the first frame.

    Attributes:
        times: frames [s].
        kinetic: sum of m v^2 / 2 over the particles; what a particle turns within itself is not in it.
        gravitational: - sum of m g . x, zero at the first frame.
        elastic: stored by the law.
        grip_work: done by the grips on the body, gripped material included.
        contact_work: done by the ground and by colliders on the body, friction included.
        term_work: done by the forces of effects.
        drag: taken by linear air drag.
        dissipated: work of the stresses that is not stored.
        transfers: kinetic energy lost between particles and grid.
    """

    times: Array
    kinetic: Array
    gravitational: Array
    elastic: Array
    grip_work: Array
    contact_work: Array
    term_work: Array
    drag: Array
    dissipated: Array
    transfers: Array

    @property
    def mechanical(self) -> Array:
        """Kinetic, gravitational and elastic energy together."""
        return self.kinetic + self.gravitational + self.elastic

    @property
    def lost(self) -> Array:
        """The remainder: what the numerics lost (negative: gained) since the first frame."""
        done = self.grip_work + self.contact_work + self.term_work - self.drag - self.dissipated
        remainder: Array = done - (self.mechanical - self.mechanical[0])
        return remainder

    @property
    def turnover(self) -> float:
        """Scale of the energies that were exchanged: the largest kinetic energy, or span of another column."""
        columns = (
            self.kinetic, self.gravitational, self.elastic, self.grip_work, self.contact_work, self.term_work,
            self.drag, self.dissipated, self.transfers,
        )  # fmt: skip
        return max(float(np.ptp(column)) for column in columns)


def run_particles_with_ledger(
    engine: UpdatedLagrangian,
    x: Array,
    v: Array,
    held: HeldNodes,
    times: Array,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Array, ParticleLedger]:
    """:meth:`UpdatedLagrangian.run_particles` with an account of the energy: its arguments, its errors.

    Returns:
        positions of the particles (T, P, 3) [m], those without a ledger to rounding, and the ledger.
    """
    run = engine.prepare(x, v, held)
    meter = ParticleMeter(run)
    run.meter = meter
    particles = run.record(times, progress)
    sums = np.array(meter.rows)
    works = sums - sums[0]
    elastic, kinetic = np.array(meter.elastic), np.array(meter.kinetic)
    moved = particles - particles[0]
    height = -np.einsum("p,tpi,i->t", engine.mass, moved, engine.problem.gravity_m_s2)
    return particles, ParticleLedger(
        times=np.asarray(times, dtype=float),
        kinetic=kinetic,
        gravitational=height,
        elastic=elastic,
        grip_work=works[:, _GRIPS] + works[:, _END] - works[:, _BACK],
        contact_work=works[:, _CONTACTS],
        term_work=works[:, _KICKED] - works[:, _BEGIN],
        drag=-works[:, _DRAG],
        dissipated=-works[:, _STRESS] - (elastic - elastic[0]),
        transfers=works[:, _KICKED]
        - works[:, _GRID_BEFORE]
        + works[:, _GRID_AFTER]
        - works[:, _BACK]
        + works[:, _STOPPED],
    )


class ParticleMeter:
    """Sums the works of one run as it is integrated.

    Attributes:
        rows: the sums at the frames, (T, 12).
        kinetic, elastic: of the particles at the frames [J], (T,).
    """

    def __init__(self, run: ParticleRun) -> None:
        self._run = run
        self._sums = wp.zeros(12, dtype=wp.float64, device=run.device)
        self.rows: list[Array] = []
        self.kinetic: list[float] = []
        self.elastic: list[float] = []

    def enclose(self, nodes: int) -> None:
        """The grid has so many nodes from now on."""
        device = self._run.device
        self._momentum, self._impulse = (wp.zeros(nodes + 1, dtype=wp.vec4f, device=device) for _ in range(2))

    def begin(self) -> None:
        """A substep begins."""
        self._particles(_BEGIN)

    def kicked(self) -> None:
        """Terms have kicked the particles, which go to the grid now."""
        self._particles(_KICKED)

    def scattered(self, momentum: wp.array, impulse: wp.array) -> None:
        """The grid has its momentum (n,) and the impulse of the stresses (n,), and has not advanced."""
        wp.copy(self._momentum, momentum)
        wp.copy(self._impulse, impulse)

    def returned(self, velocity: wp.array) -> None:
        """Grid velocities (n,) are final and the particles have taken them; grips have not placed theirs."""
        run, problem = self._run, self._run.engine.problem
        wp.launch(
            sum_grid_works, dim=run.box.nodes,
            inputs=[wp.vec3f(*problem.gravity_m_s2), problem.drag_per_s, run.clock, run.box.device_box,
                    self._momentum, self._impulse, velocity],
            outputs=[self._sums], device=run.device,
        )  # fmt: skip
        self._particles(_BACK)

    def ended(self) -> None:
        """Velocities are those of the substep's end."""
        self._particles(_END)

    def frame(self) -> None:
        """A frame is reached."""
        run, engine = self._run, self._run.engine
        velocity = run.particles.v.numpy().reshape(-1, 3).astype(float)
        self.rows.append(self._sums.numpy().copy())
        self.kinetic.append(float(0.5 * engine.mass @ np.sum(velocity**2, axis=1)))
        self.elastic.append(stored_energy(engine, run.particles.F.numpy()[: len(engine.solid)]))

    def _particles(self, column: int) -> None:
        run = self._run
        wp.launch(
            sum_kinetic, dim=len(run.engine.solid), inputs=[run.mass, run.particles.v, column],
            outputs=[self._sums], device=run.device,
        )  # fmt: skip


def stored_energy(engine: UpdatedLagrangian, F: Array) -> float:
    """Energy [J] that particles with elastic deformation gradients ``F`` (P, 3, 3) store.

    With a flow law it is that of Hencky's strains, whose stress the flow law returns.
    """
    problem, plasticity = engine.problem, engine.plasticity
    measure = engine.volume
    if problem.stiffness_factor is not None:
        measure = measure * np.asarray(problem.stiffness_factor)[engine.solid]
    if plasticity is None:
        return float(measure @ engine.law.energy_density(F))
    mu, lam = engine.law.lame
    strain = np.log(np.linalg.svd(F, compute_uv=False))
    return float(measure @ (mu * np.sum(strain**2, axis=1) + 0.5 * lam * np.sum(strain, axis=1) ** 2))
