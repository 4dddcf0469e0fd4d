"""One run of the updated Lagrangian form: the particles' and the grid's arrays, the captured substeps, the checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.captured import CHUNK, Chunk
from physworld.engine.problem import HeldNodes
from physworld.engine.total.node_kernels import advance_counter
from physworld.engine.updated.contact import press_all
from physworld.engine.updated.grid_box import GridBox
from physworld.engine.updated.grid_kernels import advance_grid, place_grips, scatter_grips
from physworld.engine.updated.grips import ParticleGrips
from physworld.engine.updated.stress import ParticleStress
from physworld.engine.updated.transfer_kernels import (
    ESCAPED,
    INVERTED,
    NOT_FINITE,
    RIM,
    grid_to_particles,
    particles_to_grid,
)
from physworld.errors import CFLViolation, ParticlesLeftTheGrid, UnstableSimulation

if TYPE_CHECKING:
    from physworld.engine.updated.energy import ParticleMeter
    from physworld.engine.updated.formulation import UpdatedLagrangian

_GROUP = 32  # particles that a thread takes in turn on a CPU: what a thread costs is shared
_INSTANT = 1e-12  # [s], in which the first stress is found


@dataclass(frozen=True)
class Particles:
    """Device arrays of the particles' state: positions (3P,), velocities (3P,), C (9P,), F (P,), stress (6P,);

    the last three padded to a multiple of 8 particles.
    """

    x: wp.array
    v: wp.array
    C: wp.array
    F: wp.array
    stress: wp.array


class ParticleRun:
    """One integration: device arrays of the grid, the captured substeps, the checks.

    Args:
        engine: problem, grid and time step.
        particles: their state on the device.
        stress: of the law, launched once here.
        grips: particles that are led, and their paths.
    """

    def __init__(
        self, engine: UpdatedLagrangian, particles: Particles, stress: ParticleStress, grips: ParticleGrips
    ) -> None:
        device = engine.problem.device
        self.engine, self.device, self.particles = engine, device, particles
        self.stress = stress
        self.gripped = len(grips.particles)
        self.grip_arrays = grips.upload(device)
        self.goal = wp.zeros(max(self.gripped, 1), dtype=wp.vec3d, device=device)
        self.box = GridBox(engine.grid, device)
        self.mass = wp.array(engine.mass.astype(np.float32), dtype=wp.float32, device=device)
        self.clock = wp.zeros(3, dtype=wp.float64, device=device)
        self.counter = wp.zeros(3, dtype=wp.int32, device=device)
        self.flags = wp.zeros(4, dtype=wp.int32, device=device)
        self.extremes = wp.zeros(1, dtype=wp.float32, device=device)
        self.crossing = 0.0
        self.chunk: Chunk | None = None
        self.meter: ParticleMeter | None = None
        instant = wp.array([_INSTANT, 1.0 / _INSTANT, _INSTANT], dtype=wp.float64, device=device)
        stress.launch(particles.F, particles.C, particles.stress, instant, self.flags)

    def record(self, times: Array, progress: Callable[[int, int], None] | None) -> Array:
        """Particles at ``times``, (T, P, 3); see :meth:`UpdatedLagrangian.run_particles`."""
        engine, frames = self.engine, len(times)
        recorded = np.empty((frames, len(engine.solid), 3))
        recorded[0] = self._positions()
        engine.terms.begin(times, recorded[0])
        self.chunk = None  # the terms have new arrays
        if self.meter is not None:
            self.meter.frame()
        for frame in range(frames - 1):
            interval = float(times[frame + 1] - times[frame])
            chunks = max(1, int(np.ceil(interval / (self._time_step(times[frame], interval) * CHUNK))))
            dt = interval / (chunks * CHUNK)
            self.clock.assign(np.array([interval, 1.0 / dt, dt]))
            self.counter.assign(np.array([frame, 0, chunks * CHUNK], dtype=np.int32))
            self._enclose(times[frame])
            for number in range(chunks):
                assert self.chunk is not None
                self.chunk.launch()
                engine.substeps += CHUNK
                self._check(times[frame] + (number + 1) * CHUNK * dt, dt)
            recorded[frame + 1] = self._positions()
            if self.meter is not None:
                self.meter.frame()
            if progress is not None:
                progress(frame + 1, frames - 1)
        return recorded

    def released(self, held: HeldNodes) -> ParticleRun:
        """A run that goes on from here with other grips."""
        return ParticleRun(self.engine, self.particles, self.stress, self.engine.grips(held))

    def _positions(self) -> Array:
        positions: Array = self.particles.x.numpy().reshape(-1, 3).copy()
        return positions

    def _time_step(self, time: float, interval: float) -> float:
        """The stable step, or less where particles are fast: none should cross much of a cell in a substep."""
        engine = self.engine
        speeds = np.abs(self.particles.v.numpy().reshape(-1, 3)).max(axis=0)
        speeds = speeds + np.abs(engine.problem.gravity_m_s2) * interval
        crossed = float((speeds / engine.grid.spacing).max())
        if not np.isfinite(crossed):
            bad = int((~np.isfinite(self.particles.v.numpy().reshape(-1, 3))).any(axis=1).sum())
            raise UnstableSimulation(
                f"{bad} of {len(engine.solid)} velocities are not finite at t = {time:.4f} s"
            )
        step = min(engine.time_step_s, engine.crossing_limit / crossed) if crossed > 0 else engine.time_step_s
        fastest = float(np.linalg.norm(speeds))
        for contact in engine.terms.contacts:
            closing = fastest + contact.fastest_m_s
            step = min(step, contact.step_m / closing) if closing > 0 else step
        self.crossing = crossed * step
        return step

    def _enclose(self, time: float) -> None:
        rim = max(1, int(np.ceil(2 * CHUNK * self.crossing)))
        if self.box.enclose(self._positions(), rim, time) or self.chunk is None:
            self._capture()
        self.flags.zero_()

    def _check(self, time: float, dt: float) -> None:
        flags, crossing = self.flags.numpy(), float(self.extremes.numpy()[0])
        engine = self.engine
        if flags[NOT_FINITE] or not np.isfinite(crossing):
            raise UnstableSimulation(
                f"a particle's state is not finite at t = {time:.4f} s with time step {dt:.3g} s "
                f"(stable: {engine.time_step_s:.3g} s)"
            )
        engine.terms.check(time, dt)
        if flags[INVERTED]:
            raise UnstableSimulation(
                f"a particle inverted by t = {time:.4f} s with time step {dt:.3g} s: its volume ratio fell below 0.02 "
                "or a stretch below 1e-4"
            )
        if crossing > 1.0:
            raise CFLViolation(
                f"a particle crossed {crossing:.3g} cells of {engine.grid.spacing.min():.3g} m in one substep of "
                f"{dt:.3g} s before t = {time:.4f} s"
            )
        if flags[ESCAPED]:
            raise ParticlesLeftTheGrid(
                f"a particle left the box of {tuple(self.box.counts.tolist())} nodes within {CHUNK} substeps of "
                f"{dt:.3g} s before t = {time:.4f} s; the fastest crossed {crossing:.3g} cells a substep"
            )
        self.crossing = crossing
        self.extremes.zero_()
        if flags[RIM]:
            self._enclose(time)

    def _capture(self) -> None:
        nodes, device = self.box.nodes, self.device
        split, gripped = self.engine.transfer.split or self.meter is not None, self.gripped > 0

        def nodal(used: bool) -> wp.array:
            # A row reads one node more.
            return wp.zeros(nodes + 1 if used else 1, dtype=wp.vec4f, device=device)

        self.momentum, self.impulse, self.grip = nodal(True), nodal(split), nodal(gripped)
        self.velocity, self.velocity_old = nodal(True), nodal(split)
        if self.meter is not None:
            self.meter.enclose(nodes)
        self.seen = nodal(any(contact.at_once for contact in self.engine.terms.contacts))
        self.chunk = Chunk(self._substep, device)

    def _substep(self) -> None:
        engine, q, box = self.engine, self.particles, self.box.device_box
        problem, transfer, grid = engine.problem, engine.transfer, engine.grid
        terms, count, meter, split = engine.terms, len(engine.solid), self.meter, int(transfer.split)
        apart = 1 if meter is not None else split
        group = 1 if wp.get_device(self.device).is_cuda else _GROUP
        groups = -(-count // group)
        origin, inverse = wp.vec3d(*grid.origin), 1.0 / grid.spacing
        clear = -np.inf if terms.ground_height_m is None else terms.ground_height_m + grid.spacing[2]
        space = [wp.vec3f(*inverse), wp.vec3f(*grid.spacing)]

        def launch(kernel: object, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

        if meter is not None:
            meter.begin()
        terms.launch(q.x, q.v, q.F, q.stress, self.clock, self.counter)
        if meter is not None:
            meter.kicked()
        launch(
            particles_to_grid, groups,
            [group, count, self.mass, origin, *space, apart, self.clock, box, q.x, q.v, q.C, q.stress],
            [self.momentum, self.impulse, self.flags],
        )  # fmt: skip
        if self.gripped:
            numbers, path_x, path_v, path_gradient = self.grip_arrays
            launch(
                scatter_grips, self.gripped,
                [numbers, self.mass, path_x, path_v, path_gradient, origin, wp.vec3d(*inverse), self.clock,
                 self.counter, box, q.x],
                [self.goal, self.grip, self.flags],
            )  # fmt: skip
        for contact in terms.contacts:
            contact.find(q.x, self.clock, self.counter)
        if meter is not None:
            meter.scattered(self.momentum, self.impulse)
        launch(
            advance_grid, self.box.nodes,
            [wp.vec3f(*problem.gravity_m_s2), problem.drag_per_s, int(self.gripped > 0), self.clock, box,
             self.momentum, self.impulse, self.grip],
            [self.velocity, self.velocity_old, apart],
        )  # fmt: skip
        press_all(terms.contacts, q.x, box, self.velocity, self.seen)
        sharing = [split, engine.velocity_share, engine.separating_volume, wp.float64(clear)]
        launch(
            grid_to_particles, groups,
            [group, count, origin, *space, *sharing, self.clock, box, self.velocity, self.velocity_old,
             self.stress.ratio, q.x, q.v, q.C],
            [self.flags, self.extremes],
        )  # fmt: skip
        if meter is not None:
            meter.returned(self.velocity)
        if self.gripped:
            launch(
                place_grips,
                self.gripped,
                [numbers, path_gradient, path_v, self.counter, self.goal],
                [q.x, q.v, q.C],
            )
        if meter is not None:
            meter.ended()
        self.stress.launch(q.F, q.C, q.stress, self.clock, self.flags)
        launch(advance_counter, 1, [self.counter], [])
