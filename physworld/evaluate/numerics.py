"""How much of a twin's prediction is the solver's own: its damping, and what a finer step or lattice would change.

Three suspects are measured on the scene at hand, since no scheme is innocent in general:

- *Damping*. The body swings freely: grips stand still, drag, friction, flow and effects are off. The energy that the
  run loses (in the updated Lagrangian form nearly all of it in the transfers) is stated as the linear drag c that would
  take as much, lost = 2 c * integral of the kinetic energy [1/s], and as the damping ratio c / (2 omega) of the
  dominant mode, the tracked points' strongest frequency.
- *Time step*. The recording is predicted with half the time step.
- *Lattice*. The recording is predicted with finer cells.

An effect whose strength or sign follows one of these is a numerical error.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.engine.total.energy import EnergyLedger
from physworld.engine.updated.energy import ParticleLedger
from physworld.errors import SceneUnsupported, SimulationError
from physworld.estimation.simulations import Drive, Job, Runner, in_turn
from physworld.scene import Scene
from physworld.twin.build import build_twin
from physworld.twin.integration import Integration
from physworld.twin.properties import carried
from physworld.twin.twin import Twin

REFINEMENT = 1.5  # cells of the finer lattice are this many times smaller
_OTHERS = (
    1.0,
    1.1,
    0.9,
    1.2,
    0.8,
    1.35,
    0.7,
    1.5,
)  # refinements that are tried, over the one that is asked for
_NEAR = 0.35  # logarithm of the number of particles over the wanted one: close enough
_STILL = 1e-3  # a free run whose points move less than this share of the body's size is kicked
_KICK_PER_S = 0.05  # speed of the kick, body sizes a second
_LEAST_PERIODS = 1.5  # of the dominant mode, to tell its frequency

Poll = Callable[[int, int], None]


@dataclass(frozen=True)
class Numerics:
    """What the numerics do to one twin's prediction of one scene.

    Attributes:
        equivalent_drag_per_s: linear drag that would lose as much energy as the scheme does [1/s]; negative: gain.
        damping_ratio: that loss as a share of critical damping of the dominant mode; None without such a mode.
        dominant_mode_hz: strongest frequency of the free swing; None where the run is too short to show one.
        lost_share: energy that the scheme lost over the recording, over the largest energy exchanged.
        time_step_s: the twin's largest time step.
        half_step_m: root mean squared change of the predicted tracks when the time step is halved [m].
        finer_cells_m: root mean squared change of the predicted tracks on the finer lattice [m].
        refinement: factor between the two lattices; particles and finer_particles are their sizes.
        simulations: runs used.
        seconds: wall time.
    """

    equivalent_drag_per_s: float
    damping_ratio: float | None
    dominant_mode_hz: float | None
    lost_share: float
    time_step_s: float
    half_step_m: float
    finer_cells_m: float
    refinement: float
    particles: int
    finer_particles: int
    simulations: int
    seconds: float


def measure_numerics(
    scene: Scene,
    twin: Twin,
    *,
    particle_budget: int = 2000,
    refinement: float = REFINEMENT,
    progress: Callable[[int, int, str], None] | None = None,
    poll: Callable[[int, int], None] | None = None,
    refined_tracks: RefinedTracks | None = None,
) -> Numerics:
    """Measure a calibrated twin's numerics on its scene.

    Args:
        scene: the recording; only its controls, times and declared facts are used.
        twin: calibrated, of either form.
        particle_budget: the one that the twin was built with.
        refinement: cells of the finer lattice are this many times smaller.
        progress: called with (runs done, runs in all, what comes next); may raise to stop.
        poll: called with (frames done, frames in all) of every run; may raise to stop.
        refined_tracks: of :func:`refined_tracks_of` with the same settings, where they are known already.

    Raises:
        SceneUnsupported: the body is a mesh of triangles, which has no finer cells.
        SimulationError: a run cannot be trusted.
    """
    begun = time.perf_counter()
    tell = progress or (lambda done, most, text: None)
    tell(0, 4, "free swing without friction")
    damping = free_swing(scene, twin, poll=poll)
    tell(1, 4, "prediction with its energy ledger")
    control_times, controls = scene.control_track()
    run = twin.integration(control_times, controls, scene.times)
    carriers, ledger, step = _run_with_ledger(twin, run, run.velocity, poll=poll)
    track = twin.observe(carriers, scene.times)
    tell(2, 4, "half the time step and finer cells")
    finer = refined_tracks or refined_tracks_of(scene, twin, particle_budget, refinement, poll)
    tell(4, 4, "done")
    return Numerics(
        equivalent_drag_per_s=damping.equivalent_drag_per_s,
        damping_ratio=damping.damping_ratio,
        dominant_mode_hz=damping.mode_hz,
        lost_share=float(ledger.lost[-1] / max(ledger.turnover, 1e-300)),
        time_step_s=step,
        half_step_m=_rms(finer.half_step - track),
        finer_cells_m=_rms(finer.finer_cells - track),
        refinement=refinement,
        particles=twin.lattice.fill.size,
        finer_particles=finer.particles,
        simulations=4,
        seconds=time.perf_counter() - begun,
    )


@dataclass(frozen=True)
class RefinedTracks:
    """What a twin predicts with finer numerics.

    Attributes:
        half_step: with half the time step, (T, N, 3) [m].
        finer_cells: on the finer lattice, (T, N, 3) [m].
        particles: of the finer lattice.
    """

    half_step: Array
    finer_cells: Array
    particles: int


def refined_tracks_of(
    scene: Scene,
    twin: Twin,
    particle_budget: int,
    refinement: float = REFINEMENT,
    poll: Poll | None = None,
    runner: Runner = in_turn,
) -> RefinedTracks:
    """Predictions of the recording with half the time step and with finer cells; both are the runner's.

    Args:
        scene: the recording; its controls and times drive the runs.
        twin: calibrated.
        particle_budget: the one that the twin was built with.
        refinement: factor between the cell sizes.
        poll: told (runs done, runs in all), or None.
        runner: of the simulations.

    Raises:
        SceneUnsupported: the body is a mesh of triangles, which has no finer cells.
        SimulationError: a run cannot be trusted.
    """
    finer = refined(scene, twin, particle_budget, refinement)
    frames = len(scene.times)
    jobs = {"half the time step": Job(twin, frames, step_share=0.5), "finer cells": Job(finer, frames)}
    drive = Drive(*scene.control_track(), scene.times)
    half_step, finer_cells = trusted_tracks(jobs, drive, poll, runner)
    return RefinedTracks(half_step, finer_cells, finer.lattice.fill.size)


def trusted_tracks(
    jobs: dict[str, Job], drive: Drive, poll: Poll | None = None, runner: Runner = in_turn
) -> list[Array]:
    """Tracks (frames, N, 3) [m] of jobs by what they are, in their order. Raises SimulationError where one failed.

    Args:
        jobs: simulations by what they are.
        drive: control points and frame times of them all.
        poll: told (runs done, runs in all), or None.
        runner: of the simulations.
    """
    found: list[Array] = []
    asked = runner(list(jobs.values()), drive, lambda: None if poll is None else poll(len(found), len(jobs)))
    for name, tracks in zip(jobs, asked, strict=True):
        if tracks is None:
            raise SimulationError(f"the run with {name} blew up or left its grid")
        found.append(tracks)
    return found


def refined(scene: Scene, twin: Twin, particle_budget: int, refinement: float = REFINEMENT) -> Twin:
    """The same twin on a lattice whose cells are about ``refinement`` times smaller, with the same material points.

    Cells end at the faces of grips, so that not every size can be had: of some refinements about the one that is asked
    for, the first whose number of particles is near, or else the nearest.

    Args:
        scene: that the twin was built of.
        twin: calibrated.
        particle_budget: the one that the twin was built with.
        refinement: factor between the cell sizes.

    Raises:
        SceneUnsupported: the body is a mesh of triangles: its cells are what is supposed of the recording.
    """
    if not twin.lattice.smooth:
        raise SceneUnsupported(f"{twin.lattice.title} has no finer ones to be asked")
    wanted = twin.lattice.fill.size * refinement**twin.lattice.dim
    found: list[tuple[float, Twin]] = []
    for other in _OTHERS:
        finer = build_twin(
            scene,
            particle_budget,
            twin.device,
            refinement * other,
            twin.plasticity,
            twin.formulation,
            twin.transfer,
        )
        found.append((abs(float(np.log(finer.lattice.fill.size / wanted))), finer))
        if found[-1][0] <= _NEAR:
            break
    finer = min(found, key=lambda pair: pair[0])[1]
    body = replace(finer.body, points=twin.body.points, offsets=twin.body.offsets)
    return replace(
        finer,
        body=body,
        law=twin.law,
        gravity_m_s2=twin.gravity_m_s2,
        air_drag_per_s=twin.air_drag_per_s,
        grip_softness=twin.grip_softness,
        ground_height_m=twin.ground_height_m,
        ground_friction=twin.ground_friction,
        effects=twin.effects,
        properties=carried(twin.properties, twin.particles_rest, finer.particles_rest),
    )


@dataclass(frozen=True)
class FreeSwing:
    """A free swing without any physical friction.

    Attributes:
        equivalent_drag_per_s: linear drag that would lose as much energy [1/s].
        mode_hz: strongest frequency of the tracked points; None where the run shows no whole period.
        ledger: where the energy went.
    """

    equivalent_drag_per_s: float
    mode_hz: float | None
    ledger: EnergyLedger | ParticleLedger

    @property
    def damping_ratio(self) -> float | None:
        """c / (2 omega): an amplitude loses exp(-2 pi ratio) in a period."""
        return None if self.mode_hz is None else self.equivalent_drag_per_s / (4 * np.pi * self.mode_hz)


def free_swing(
    scene: Scene,
    twin: Twin,
    *,
    time_step_s: float | None = None,
    poll: Callable[[int, int], None] | None = None,
) -> FreeSwing:
    """The twin's body, let go at the start of the scene with all physical friction off and its grips at rest.

    A body that hangs in balance is kicked sideways first. Frames are those of the scene.

    Args:
        scene: whose start and frames are used.
        twin: calibrated.
        time_step_s: of the run [s]; None: the twin's own.
        poll: told (frames done, frames in all), or None.

    Raises:
        SimulationError: the run cannot be trusted.
    """
    silent = replace(
        twin,
        law=twin.law.without_friction(),
        air_drag_per_s=0.0,
        ground_friction=0.0,
        self_friction=None if twin.self_friction is None else 0.0,
        effects=(),
        plasticity=None,
        release_s=0.0,
        openings=(),
    )
    control_times, controls = scene.control_track()
    still = np.repeat(controls[:1], len(control_times), axis=0)
    run = silent.integration(control_times, still, scene.times)
    start, velocity = twin.body.start, run.velocity.copy()
    size = float(np.ptp(start, axis=0).max())
    held = np.unique(run.held.nodes)
    nodes, ledger, _ = _run_with_ledger(silent, run, velocity, time_step_s, poll)
    if np.linalg.norm(nodes - nodes[0], axis=2).max() < _STILL * size:
        free = np.setdiff1d(np.arange(len(start)), held)
        velocity[free] += _KICK_PER_S * size * _across(start, twin.gravity_m_s2)
        nodes, ledger, _ = _run_with_ledger(silent, run, velocity, time_step_s, poll)
    spent = float(np.trapezoid(ledger.kinetic - ledger.kinetic.min(), ledger.times))
    lost = ledger.lost + ledger.dissipated if isinstance(ledger, ParticleLedger) else ledger.lost
    drag = 0.0 if spent == 0 else float(lost[-1]) / (2 * spent)
    tracks = silent.track_nodes(nodes)
    return FreeSwing(drag, dominant_frequency(scene.times, tracks), ledger)


def dominant_frequency(times: Array, tracks: Array) -> float | None:
    """Strongest frequency [Hz] of the first principal motion of tracks (T, N, 3); None below 1.5 periods.

    Args:
        times: (T,) [s], even or not (they are made even by interpolation).
        tracks: points, (T, N, 3) [m].
    """
    even = np.linspace(times[0], times[-1], len(times))
    motion = (tracks - tracks.mean(axis=0)).reshape(len(tracks), -1)
    first = np.linalg.svd(motion, full_matrices=False)
    signal = np.interp(even, times, first[0][:, 0] * first[1][0])
    if np.ptp(signal) == 0:
        return None
    padded = 8 * len(signal)
    power = np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(len(signal)), padded))
    frequency = np.fft.rfftfreq(padded, even[1] - even[0])
    least = _LEAST_PERIODS / (times[-1] - times[0])
    allowed = np.flatnonzero(frequency >= least)
    if not len(allowed):  # three frames or fewer
        return None
    peak = allowed[np.argmax(power[allowed])]
    if peak == allowed[0] or peak + 1 >= len(power):
        return None
    left, middle, right = np.log(power[peak - 1 : peak + 2])
    shift = 0.5 * (left - right) / (left - 2 * middle + right)
    return float((peak + shift) * frequency[1])


def _run_with_ledger(
    twin: Twin,
    run: Integration,
    velocity: Array,
    time_step_s: float | None = None,
    poll: Poll | None = None,
) -> tuple[Array, EnergyLedger | ParticleLedger, float]:
    """Carriers at the frames (T, n, 3), the ledger at the knots, and the largest time step [s]."""
    solver = twin.solver(run.problem, time_step_s)
    carriers, ledger = twin.form.run_with_ledger(solver, twin.course(run, velocity), poll)
    return run.at_frames(twin.carriers_start, carriers), ledger, solver.time_step_s


def _across(start: Array, gravity: Array) -> Array:
    """The level direction in which the body is thinnest: unit vector (3,)."""
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-12)
    spread = start - start.mean(axis=0)
    level = spread - (spread @ down)[:, None] * down
    blocked = 2 * np.sum(spread**2) * np.outer(down, down)
    return np.linalg.eigh(level.T @ level + blocked)[1][:, 0]


def _rms(difference: Array) -> float:
    """Root mean squared length of vectors (T, N, 3)."""
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))
