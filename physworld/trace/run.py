"""A trace from beginning to end: calibrate, find the residual, name the effect, add it, and measure what it brought.

1. Freeze the split. Calibrate the declared physics on the training frames, with several starts and no damping.
2. Noise; whitening by noise and by the points' own places; what other cells and time steps change.
3. Sensitivities of the calibrated parameters and of every candidate; scores, decoys, and what chance would reach.
4. Refit the best candidates with everything; where the best single leaves too much, pairs.
5. Refit the winner and its rivals on finer cells: the strength has to agree.
6. The verdict; intervals; then, once, the held-out frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import Journal
from physworld.calibrate.parameters import BENDING_COUPLING, TWIST_RATIO, parameters_of
from physworld.engine.thin.triangles import TriangleLattice
from physworld.errors import SceneUnsupported
from physworld.estimation.noise import noise_sigma
from physworld.estimation.refit import refit
from physworld.estimation.simulations import Job, Memory, Progress, Runner, in_turn, stage_s
from physworld.estimation.unknowns import Unknown
from physworld.estimation.whitening import Whitener, turned_starts, whitener
from physworld.scene import Scene
from physworld.trace.candidates import Candidate, candidates
from physworld.trace.comparison import cross_validated
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model, held_otherwise
from physworld.trace.experiment import Experiment, propose, rival_of
from physworld.trace.faults import Faults, without_faults
from physworld.trace.held_out import Outcomes
from physworld.trace.intervals import calibrated, named, spread_of
from physworld.trace.mixtures import Mixtures
from physworld.trace.preparation import (
    CONFIRMATION,
    EXPERIMENT,
    SELECTION,
    Beginning,
    Clock,
    remarks,
    taken_with,
)
from physworld.trace.recordings import (
    FITTED,
    HELD_OUT,
    JointSimulations,
    Recordings,
    side_by_side,
)
from physworld.trace.report import describe
from physworld.trace.result import Stage, Step, TraceResult
from physworld.trace.score import orthonormal, project
from physworld.trace.second_resolution import SecondResolution
from physworld.trace.selection import Selection, by_chance
from physworld.trace.sensitivity import (
    candidate_responses,
    numerical_directions,
    refinement_of,
)
from physworld.trace.unknowns import KNOWN_BEFOREHAND, hold_unknowns, of_parameter
from physworld.trace.verdict import (
    DATA,
    NOTHING,
    UNEXPLAINED,
    Verdict,
    claimable,
    decide,
    implausible,
    simplest_first,
)
from physworld.twin.twin import Twin

_OTHER_STIFFNESSES = tuple(0.12 * k for k in (-6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6))
"""Logarithms: a phase that has slipped by a period is a local minimum, so others are looked at before a descent."""
_MESH_STIFFNESSES = tuple(0.01 * k for k in (-4, -3, -2, -1, 1, 2, 3, 4))
"""Of a mesh of triangles also these: its wrinkles make basins that are a few percent of its stiffness wide."""
_OTHER_TWIST = float(np.log(2.0))
_NEAR = (-0.12, 0.12)  # on finer cells, where the coarser ones have looked farther
_THOROUGH = 2  # times the iterations of other refits: everything is compared with the declared physics
_SLOWEST = 12.0  # times the cost of the declared physics that a run may take: strong friction is dear


def trace(
    scene: Scene | Sequence[Scene],
    config: TraceConfig | None = None,
    *,
    held_out: Sequence[Scene] = (),
    runner: Runner = in_turn,
    memory: Memory | None = None,
    journal: Journal | None = None,
    calibrated_twin: Twin | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> TraceResult:
    """Trace a recording, or several of one object.

    Args:
        scene: the recording; or several, which share material and effects. The first one is calibrated alone first,
            and its tracks are those of the result.
        config: settings; None for the defaults.
        held_out: recordings of the same object that only the report sees.
        runner: where simulations run.
        memory: simulations that were run before; with the same memory a trace that was cut off goes on.
        journal: of the calibration, likewise.
        calibrated_twin: the declared physics, calibrated on the training frames; None to do that here.
        progress: called with (simulations done, 0 while the number is open, stage).
        cancelled: polled between simulations.

    Raises:
        CalibrationError: no start gave a usable simulation.
        Cancelled: ``cancelled`` returned true.
        SceneUnsupported: the scene declares too little for a body; the recordings are of different kinds; or the
            calibrated twin carries a field.
        ValueError: ``config.noise_m`` is not positive.
    """
    if calibrated_twin is not None and calibrated_twin.properties is not None:
        raise SceneUnsupported(
            f"the calibrated twin carries a field over its {len(calibrated_twin.properties)} particles; a trace "
            "works on a homogeneous one, so that an effect is not hidden by it"
        )
    config = config or TraceConfig()
    begun = time.perf_counter()
    both = ([scene] if isinstance(scene, Scene) else scene, held_out)
    scenes, held_out = (taken_with(many, config.noise_m) for many in both)
    recordings = Recordings(scenes, held_out, config.blocks, config.shortest_block)
    begin = Beginning(config, runner, memory, progress, cancelled)
    simulations, twin, runs = begin.calibrated(recordings, calibrated_twin, journal)
    faults = begin.faults(simulations, twin)
    if any(faults):
        scenes = [without_faults(s, known) for s, known in zip(scenes, faults, strict=True)]
        recordings = Recordings(scenes, held_out, config.blocks, config.shortest_block)
        looked = runs + simulations.count
        simulations, twin, runs = begin.calibrated(recordings, None, None)
        runs += looked
    clock = Clock(begun, config.time_limit_s, begin.ledger)
    kind: type[_Trace] = _Trace
    if config.method == "evidence":
        from physworld.trace.evidence.inference import Inference  # it goes on from the class below

        kind = Inference
    work = kind(recordings, config, simulations, twin, faults, clock)
    result = work.run()
    stages = tuple(Stage(name, *cost) for name, cost in begin.ledger.spent.items())
    return replace(
        result,
        simulations=simulations.count + runs,
        seconds=time.perf_counter() - begun,
        stages=stages,
        notes=(*begin.notes, *result.notes),
    )


class _Trace:
    """State of one trace."""

    def __init__(
        self,
        recordings: Recordings,
        config: TraceConfig,
        simulations: JointSimulations,
        twin: Twin,
        faults: tuple[Faults, ...],
        clock: Clock,
    ) -> None:
        self.recordings, self.lead, self.clock = recordings, recordings.lead.scene, clock
        self.scene, self.split = recordings.scene, recordings.split
        self.config, self.simulations = config, simulations
        self.frames, self.twin = self.split.train[1], twin
        self.faults = "; ".join(known.words for known in faults if known)
        self.notes = [f"left out as faulty sightings: {self.faults}"] if self.faults else []

    def run(self) -> TraceResult:
        config, simulations = self.config, self.simulations
        level = 1.0
        while True:
            simulations.stage = "declared physics"
            simulations.least_step_s = stage_s(self.twin, simulations.drive) / _SLOWEST
            tracks, answers = simulations.first_look(Job(self.twin, self.frames))
            sigma = noise_sigma(self.scene, self.split, tracks)
            scale = sigma or self._rms(tracks) or 1e-3
            white = whitener(self.scene, self.split, scale, answers)
            white = white.knowing(self._turns(tracks, scale))
            simulations.stage = "numerics"
            budget = config.calibration.particle_budget
            directions, finer = numerical_directions(
                simulations, self.lead, self.twin, tracks, budget, config.refinement, level
            )
            block_of_row = self.split.block_of(white.frame_of_row)
            others = _OTHER_STIFFNESSES if level == 1.0 else _NEAR
            declared = self._declared(
                white, block_of_row, others if self.twin.lattice.smooth else (*others, *_MESH_STIFFNESSES)
            )
            basis = orthonormal(declared.fitted.free_jacobian)
            shifts = [project(basis, white.change(direction)) for direction in directions.values()]
            numerics = {
                n: float(np.sqrt(np.mean(shift**2))) for n, shift in zip(directions, shifts, strict=True)
            }
            if not self._too_coarse(numerics, finer):
                break
            level *= config.refinement
            self.twin = refinement_of(declared.fitted.twin, finer)
        if isinstance(self.twin.lattice, TriangleLattice):
            self.notes.append(f"taken as a mesh that another engine recorded, {self.twin.lattice.mesh}")
        self.notes += remarks(sigma, config.noise_m is not None, numerics)
        if level > 1.0:
            self.notes.append(f"cells {level:.3g} times smaller than asked for: coarser ones change too much")
        solver = orthonormal(np.stack(shifts, axis=1)) if shifts else basis[:, :0]
        resolved = float(np.sqrt(np.mean(project(solver, project(basis, declared.fitted.residual)) ** 2)))
        chosen, refused = candidates(declared.fitted.twin, config.candidates)
        simulations.stage = "sensitivities"
        responses = candidate_responses(
            simulations, white, declared.fitted.twin, declared.fitted.tracks, chosen, self.frames
        )
        usable = [response for response in responses if not response.failed]
        refused |= {r.candidate.label: "its simulation cannot be trusted" for r in responses if r.failed}
        setting = (simulations, white, block_of_row, self.frames, config)
        selection = Selection(*setting)
        self.clock.start()
        with self.clock.until(SELECTION):
            path = selection.path(declared, usable)
        models = [model for step in path for model in step.tried]
        facts = (solver, block_of_row, lambda model: by_chance(model, path[0].scores))
        real = claimable(declared, models, config, *facts)
        second = SecondResolution(*setting, finer, numerics.get("finer cells", 0.0))
        mixed = None
        with self.clock.until(CONFIRMATION):
            finer_values, agreement = second.check(declared, real)
            single = self._complete(declared, real, agreement)
            with simulations.time_permitting("refit of mixtures"):
                mixed = single and Mixtures(selection, second).beside(single, usable, finer_values, agreement)
        if mixed and mixed.kept:  # of the others only what may not be named still counts
            path = (*path, mixed)
            models = [mixed.kept, *(model for model in models if implausible(model) is not None)]
        tried = len({c.effect for c in chosen})
        verdict = decide(declared, models, basis, agreement, resolved, config, tried, *facts)
        if sigma is None:
            verdict = Verdict(UNEXPLAINED, declared, (), "no noise estimate, no claim: " + verdict.reason)
        if self.faults and verdict.name == NOTHING:
            reason = f"faulty sightings ({self.faults}); of the others {verdict.reason}"
            verdict = Verdict(DATA, declared, (), reason)
        verdict = self.clock.told(verdict, declared, agreement)
        found = self._result(
            verdict, declared, white, block_of_row, sigma, path, chosen, refused, numerics, finer_values
        )
        experiment, notes = None, found.notes
        with self.clock.until(EXPERIMENT), simulations.time_permitting("experiment"):
            experiment = self._experiment(verdict, white, finer)
        if simulations.ledger.cut[-1:] == ["experiment"]:
            notes = (*notes, "time was up before an experiment was found that would tell these apart")
        return replace(found, experiment=experiment, notes=notes)

    def _complete(
        self, declared: Model, real: list[Model], agreement: dict[tuple[str, ...], bool]
    ) -> Model | None:
        """What would be named, where it leaves so little that a second effect is not looked for."""
        ordered = simplest_first(real, declared)
        best = next((model for model in ordered if agreement.get(model.names)), None)
        finer = self.twin.lattice.smooth  # a mesh of triangles has no finer cells to ask
        return best if best and finer and best.fitted.misfit <= self.config.near_floor else None

    def _rms(self, tracks: Array) -> float:
        """Root mean squared residual of the sightings per axis [m]."""
        seen = self.scene.visible[: self.frames]
        return float(np.sqrt(np.mean((tracks - self.scene.points[: self.frames])[seen] ** 2)))

    def _experiment(self, verdict: Verdict, white: Whitener, finer: Twin) -> Experiment | None:
        """What would tell the models of an equivalent set apart."""
        if not verdict.equivalent or self.config.experiment is None:
            return None
        models = (verdict.model, *verdict.equivalent)
        left = max(model.fitted.misfit for model in models)
        return propose(
            self.lead,
            [rival_of(model) for model in models],
            white.sigma,
            discrepancy=float(np.sqrt(max(left**2 - 1.0, 0.0))),
            finer=finer,
            cost=lambda twin: self._cost(twin, white),
            config=self.config.experiment,
            simulations=self.simulations,
        )

    def _cost(self, twin: Twin, white: Whitener) -> float:
        """Squared whitened misfit on the training frames; infinite where the run cannot be trusted."""
        tracks = self.simulations.run([Job(twin, self.frames)])[0]
        return float("inf") if tracks is None else float(np.sum(white.residual(tracks) ** 2))

    def _too_coarse(self, numerics: dict[str, float], finer: Twin) -> bool:
        """Whether finer cells change what counts, and can be afforded."""
        if len(self.recordings.fitted) > 1 or self.recordings.held_out:
            return False  # their other twins stay on the cells that were asked for
        drive = self.simulations.drive
        steps = float(drive.times[self.frames - 1] - drive.times[0]) / stage_s(finer, drive)
        cost = finer.lattice.fill.size * steps
        return numerics.get("finer cells", 0.0) > self.config.resolved and cost <= self.config.affordable

    def _declared(self, white: Whitener, block_of_row: Array, shifts: tuple[float, ...]) -> Model:
        """The declared physics under the trace's own misfit."""
        self.simulations.stage = "declared physics"
        unknowns = self._calibrated_unknowns(self.twin)
        own = np.array([u.start for u in unknowns])
        axes = dict(zip([u.name for u in unknowns], np.eye(len(own)), strict=True))
        starts = [own + shift * axes[unknowns[0].name] for shift in shifts]
        if TWIST_RATIO in axes:  # how stiff a sheet is in twist decides in which basin its stiffness lies
            starts += [start + _OTHER_TWIST * axes[TWIST_RATIO] for start in [own, *starts]]
        iterations = _THOROUGH * self.config.iterations
        fitted = refit(self.simulations, white, self.twin, unknowns, self.frames, iterations, starts)
        if fitted is None:
            raise RuntimeError("the calibrated twin cannot be simulated again")
        fitted = held_otherwise(fitted, self.simulations, white, self.frames, self.config.iterations)
        return Model((), fitted, cross_validated(fitted, block_of_row))

    def _calibrated_unknowns(self, twin: Twin) -> list[Unknown]:
        body, ground = self.lead.body, self.lead.ground
        known = parameters_of(
            twin,
            separate_bending=body.thickness_m is None and body.size_m is None,
            damping=False,
            ground_friction=ground is not None and ground.friction is None,
        )
        found = [
            of_parameter(p, twin, KNOWN_BEFOREHAND.get(p.name)) for p in known if p.name != BENDING_COUPLING
        ]
        return [*found, *hold_unknowns(twin)]

    def _turns(self, tracks: Array, sigma: float) -> list[Array]:
        """What the uncertain pose of the start does to the prediction, (frames, N, 3) each."""
        if len(self.recordings.fitted) > 1:
            return []
        jobs = [Job(turned, self.frames) for turned in turned_starts(self.lead, self.twin, sigma)]
        return [found - tracks for found in self.simulations.run(jobs) if found is not None]

    def _result(
        self,
        verdict: Verdict,
        declared: Model,
        white: Whitener,
        block_of_row: Array,
        sigma: float | None,
        path: tuple[Step, ...],
        chosen: list[Candidate],
        refused: dict[str, str],
        numerics: dict[str, float],
        finer: dict[tuple[str, ...], dict[str, float]],
    ) -> TraceResult:
        config, simulations = self.config, self.simulations
        simulations.stage = "held-out frames"
        measured = Outcomes(self.recordings, simulations, config)
        outcomes = measured.of(declared, verdict.model, white, sigma)
        spreads = [
            spread_of(m.fitted, block_of_row, finer.get(m.names, {}), config.bootstraps, config.seed)
            for m in (verdict.model, *verdict.equivalent)
        ]
        claimed = verdict.name not in (NOTHING, UNEXPLAINED)
        unseen = [o for o in outcomes if o.role == HELD_OUT]
        held_out = measured.together(unseen or [o for o in outcomes if o.role == FITTED], sigma)
        after = side_by_side([o.after for o in outcomes if o.role == FITTED], self.scene.frame_count)
        remainder_m, remainder = describe(self.scene, after, self.split.train, white.sigma)
        return TraceResult(
            scene=self.lead.name,
            verdict=verdict,
            effects=named(verdict.model, spreads[0]) if claimed else (),
            equivalent=tuple(named(m, s) for m, s in zip(verdict.equivalent, spreads[1:], strict=True)),
            calibrated=calibrated(spreads[0].numbers()),
            declared=declared,
            split=self.recordings.lead.split,
            sigma=sigma,
            path=path,
            candidates=chosen,
            refused=refused,
            numerics=numerics,
            finer=finer,
            before=outcomes[0].before,
            after=outcomes[0].after,
            held_out=held_out,
            remainder_m=remainder_m,
            remainder=remainder,
            simulations=0,
            seconds=0.0,
            notes=(*self.notes, *measured.notes),
            recordings=tuple(outcomes),
        )
