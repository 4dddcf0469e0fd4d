"""A trace from beginning to end: calibrate, find the residual, name the effect, add it, and measure what it brought.

1. Freeze the split. Calibrate the declared physics on the training frames; leave out faulty sightings.
2. Noise; whitening by noise, by the points' own places and by what finer cells and a smaller step change (their
   estimated error as one standard deviation, Richardson's for second order).
3. The declared physics; the search over sets of effects; their posterior from left-out blocks.
4. The answer: the sets that hold 0.95 of the posterior, six at most. What remains is told beside it and forbids no
   name. Intervals; then, once, the held-out frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import Journal
from physworld.calibrate.parameters import BENDING_COUPLING, hangs_taut, parameters_of
from physworld.calibrate.rod_parameters import LOSSES, lossless, rod_parameters
from physworld.engine.formulations import RODS
from physworld.engine.thin.triangles import TriangleLattice
from physworld.errors import SceneUnsupported
from physworld.estimation.faults import Faults, without_faults
from physworld.estimation.noise import noise_sigma
from physworld.estimation.simulations import Job, Memory, Progress, Runner, in_turn, stage_s
from physworld.estimation.uncertain import doubtful
from physworld.estimation.unknowns import Unknown
from physworld.estimation.whitening import Whitener, whitener
from physworld.experiments import Experiment, propose, rival_of
from physworld.scene import Scene
from physworld.trace.answer import DATA as FAULTY
from physworld.trace.answer import NOTHING, UNEXPLAINED, Verdict, decided
from physworld.trace.candidates import candidates
from physworld.trace.config import TraceConfig
from physworld.trace.held_out import HeldOut, Outcomes
from physworld.trace.hypotheses import Hypothesis, Setting
from physworld.trace.intervals import calibrated, named, spread_of
from physworld.trace.preparation import EXPERIMENT, SEARCH, Beginning, Clock, remarks, taken_with
from physworld.trace.recordings import FITTED, HELD_OUT, JointSimulations, Recordings, side_by_side
from physworld.trace.report import describe
from physworld.trace.result import Stage, Supported, TraceResult
from physworld.trace.search import Search
from physworld.trace.sensitivity import numerical_directions
from physworld.trace.starts import Starts, early_part, elsewhere
from physworld.trace.unknowns import KNOWN_BEFOREHAND, hold_unknowns, of_parameter
from physworld.twin.twin import Twin

_THOROUGH = 2  # times the iterations of other fits: everything is compared with the declared physics
_SETTLING = 5  # rounds in turn of an error and of what places and solver take of it
_PASSES = 5  # fits of the declared physics with the solver's error as the last one has it
_SETTLED = 0.01  # relative change of the misfit that ends them
_SLOWEST = 50.0  # times the cost of the declared physics that a run may take: strong friction is dear
_RICHARDSON = {"finer cells": 2.04, "half the time step": 1.33}  # error over difference, of second order


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
    result = _Trace(recordings, config, simulations, twin, faults, clock).run()
    stages = tuple(Stage(name, *cost) for name, cost in begin.ledger.spent.items())
    return replace(
        result,
        simulations=simulations.count + runs,
        seconds=time.perf_counter() - begun,
        stages=stages,
        notes=(*begin.notes, *result.notes),
    )


@dataclass(frozen=True)
class _Ground:
    """What is known before hypotheses.

    Attributes:
        bare, white: whiteners without and with the solver's own error, of the calibrated twin.
        whitening: the second of a motion whose points answer so to their places, (frames, N, 3, r), and of its tracks.
        blocks: rows of every block of frames.
        sigma: noise [m]; None where it is not known.
        numerics: root mean squared change by other cells and steps, over the noise, by name.
        finer: the twin on finer cells.
        tracks: of the calibrated twin, (frames, N, 3) [m].
    """

    bare: Whitener
    white: Whitener
    whitening: Callable[[Array, Array], Whitener]
    blocks: list[Array]
    sigma: float | None
    numerics: dict[str, float]
    finer: Twin
    tracks: Array


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
        # what a rod loses is an effect here
        self.frames, self.given = self.split.train[1], twin
        self.twin = lossless(twin) if twin.lattice.dim == 1 else twin
        self.faults = "; ".join(known.words for known in faults if known)
        self.notes = [f"left out as faulty sightings: {self.faults}"] if self.faults else []

    def run(self) -> TraceResult:
        config, simulations = self.config, self.simulations
        ground, declared = self._settled()
        chosen, refused = candidates(declared.fitted.twin, config.candidates)
        setting = self._setting(ground, declared.fitted.twin, declared.fitted.unknowns)
        lost = self.twin is not self.given
        starts = Starts(setting, early_part(ground.bare, self.split), self._beginning() if lost else {})
        sizes = (config.confirmed, config.additions, config.effects_at_most)
        search = Search(setting, chosen, starts, *sizes, config.seed)
        self.clock.start()
        with self.clock.until(SEARCH):
            declared = search.run(declared)[0]
        known, weights = search.admitted(), search.weights()
        solver = float(np.linalg.norm([v for n, v in ground.numerics.items() if n in _RICHARDSON]))
        verdict = decided(known, weights, ground.sigma, solver, search.library)
        if self.faults and verdict.name == NOTHING:
            reason = f"faulty sightings ({self.faults}); of the others {verdict.reason}"
            verdict = Verdict(FAULTY, declared, (), reason)
        verdict = self.clock.told(verdict)
        if isinstance(self.twin.lattice, TriangleLattice):
            self.notes.append(f"taken as a mesh that another engine recorded, {self.twin.lattice.mesh}")
        self.notes += remarks(ground.sigma, config.noise_m is not None, ground.numerics)
        simulations.stage = "held-out frames"
        measured = Outcomes(self.recordings, simulations, config)
        outcomes = measured.of(declared, verdict.model, ground.sigma)
        unseen = [o for o in outcomes if o.role == HELD_OUT] or [o for o in outcomes if o.role == FITTED]
        held_out = measured.together(unseen, ground.sigma)
        shares = self._shares(verdict, declared, held_out, measured, ground)
        spreads = [
            spread_of(m, ground.blocks, config.bootstraps, config.seed)
            for m in (verdict.model, *verdict.equivalent)
        ]
        claimed = verdict.name not in (NOTHING, UNEXPLAINED)
        after = side_by_side([o.after for o in outcomes if o.role == FITTED], self.scene.frame_count)
        remainder_m, remainder = describe(self.scene, after, self.split.train, ground.white.sigma)
        experiment = None
        with self.clock.until(EXPERIMENT), simulations.time_permitting("experiment"):
            experiment = self._experiment(verdict, ground)
        if simulations.ledger.cut[-1:] == ["experiment"]:
            self.notes.append("time was up before an experiment was found that would tell these apart")
        return TraceResult(
            scene=self.lead.name,
            verdict=verdict,
            effects=named(verdict.model, spreads[0]) if claimed else (),
            equivalent=tuple(named(m, s) for m, s in zip(verdict.equivalent, spreads[1:], strict=True)),
            calibrated=calibrated(spreads[0].numbers()),
            declared=declared,
            split=self.recordings.lead.split,
            sigma=ground.sigma,
            path=search.steps,
            candidates=chosen,
            refused=refused,
            numerics=ground.numerics,
            before=outcomes[0].before,
            after=outcomes[0].after,
            held_out=held_out,
            remainder_m=remainder_m,
            remainder=remainder,
            simulations=0,
            seconds=0.0,
            experiment=experiment,
            notes=(*self.notes, *measured.notes),
            recordings=tuple(outcomes),
            supported=_supported(known, weights, ground.white.sigma),
            shares=shares,
        )

    def _settled(self) -> tuple[_Ground, Hypothesis]:
        """The declared physics where it fits best, and what its solver does not know there: each hangs on the other."""
        ground = self._ground(self.twin)
        declared = self._declared(ground)
        for _ in range(_PASSES):
            before = declared.fitted.misfit
            ground = self._ground(declared.fitted.twin)
            declared = self._declared(ground, declared)
            if abs(declared.fitted.misfit - before) <= _SETTLED * before:
                break
        return ground, declared

    def _ground(self, twin: Twin) -> _Ground:
        """Noise, what the solver does not know of itself, and the discrepancy that every hypothesis has."""
        simulations = self.simulations
        simulations.stage = "declared physics"
        simulations.least_step_s = stage_s(twin, simulations.drive) / _SLOWEST
        tracks, answers = simulations.first_look(Job(twin, self.frames))
        sigma = noise_sigma(self.scene, self.split, tracks)
        scale = sigma or self._rms(tracks) or 1e-3
        bare = whitener(self.scene, self.split, scale, answers)
        simulations.stage = "numerics"
        budget = self.config.calibration.particle_budget
        directions, finer = numerical_directions(
            simulations, self.lead, twin, tracks, budget, self.config.refinement
        )
        numerics = {n: float(np.sqrt(np.mean(bare.change(d) ** 2))) for n, d in directions.items()}
        doubt = [_RICHARDSON[n] * d for n, d in directions.items() if n in _RICHARDSON]
        also = [*self._doubtful(twin, tracks, scale), *doubt]

        def whitening(answers: Array, tracks: Array) -> Whitener:
            plain, error = whitener(self.scene, self.split, scale, answers), 1.0
            white = plain.knowing(also)
            for _ in range(_SETTLING):
                error = max(1.0, float(np.mean(white.residual(tracks) ** 2)))
                white = plain.beside(error).knowing(also, error)
            return white

        white = whitening(answers, tracks)
        block_of_row = self.split.block_of(white.frame_of_row)
        blocks = [np.flatnonzero(block_of_row == k) for k in range(self.split.blocks)]
        blocks = [rows for rows in blocks if len(rows)]
        return _Ground(bare, white, whitening, blocks, sigma, numerics, finer, tracks)

    def _declared(self, ground: _Ground, known: Hypothesis | None = None) -> Hypothesis:
        """The declared physics, begun where it is ``known`` to fit, else about where the calibration ended too."""
        self.simulations.stage = "declared physics"
        unknowns = self._unknowns()
        setting = self._setting(ground, self.twin, unknowns)
        thorough = replace(setting, iterations=_THOROUGH * self.config.iterations)
        scale = thorough.counted(float(np.mean(ground.white.residual(ground.tracks) ** 2)))
        if known is not None:
            return setting.fitted((), known.values, scale=known.unseen.scale) or known
        start = self._beginning()
        places = [place for about in elsewhere(unknowns, start) for place in about]
        places.append(start | {u.name: u.prior[0] for u in hold_unknowns(self.twin) if u.prior})
        declared = thorough.fitted((), start, places, scale=scale)
        if declared is None:
            raise RuntimeError("the calibrated twin cannot be simulated again")
        return declared

    def _beginning(self) -> dict[str, float]:
        """Where the calibration ended, by name."""
        return {u.name: u.start for u in self._unknowns()}

    def _setting(self, ground: _Ground, twin: Twin, unknowns: Sequence[Unknown]) -> Setting:
        known = (self.simulations, ground.white, ground.whitening, ground.blocks, self.frames)
        return Setting(*known, self.config.iterations, twin, unknowns)

    def _unknowns(self) -> list[Unknown]:
        """What is calibrated beside effects."""
        if self.twin.form is RODS:
            rod = rod_parameters(self.lead, self.twin)
            return [of_parameter(p, self.twin, p.prior) for p in rod if p.name not in LOSSES]
        body, ground = self.lead.body, self.lead.ground
        known = parameters_of(
            self.twin,
            separate_bending=body.thickness_m is None and body.size_m is None,
            damping=False,
            ground_friction=ground is not None and ground.friction is None,
            taut=hangs_taut(self.lead, self.twin),
        )
        found = [
            of_parameter(p, self.twin, KNOWN_BEFOREHAND.get(p.name))
            for p in known
            if p.name != BENDING_COUPLING
        ]
        return [*found, *hold_unknowns(self.twin)]

    def _shares(
        self, verdict: Verdict, declared: Hypothesis, held_out: HeldOut, measured: Outcomes, ground: _Ground
    ) -> dict[str, float]:
        """Share of the held-out error that each effect of the answer takes away, by name; together what all take.

        What an effect takes is the error that comes back when it alone is closed, the other numbers as they are.
        """
        model = verdict.model
        if verdict.name in (NOTHING, UNEXPLAINED) or not model.members:
            return {}
        whole = (held_out.before - held_out.after) / held_out.before
        if len(model.members) == 1:
            return {model.names[0]: whole}
        back = {}
        for name in model.names:
            twin = model.fitted.twin
            kept = tuple(e for e in twin.effects if e.name != name)
            without = replace(model, fitted=replace(model.fitted, twin=replace(twin, effects=kept)))
            outcomes = measured.of(declared, without, ground.sigma)
            unseen = [o for o in outcomes if o.role == HELD_OUT] or [o for o in outcomes if o.role == FITTED]
            back[name] = max(measured.together(unseen, ground.sigma).after - held_out.after, 0.0)
        total = sum(back.values())
        return {name: whole * part / total if total > 0 else whole / len(back) for name, part in back.items()}

    def _experiment(self, verdict: Verdict, ground: _Ground) -> Experiment | None:
        """What would tell the hypotheses of an equivalent set apart."""
        if not verdict.equivalent or self.config.experiment is None:
            return None
        rivals = (verdict.model, *verdict.equivalent)
        left = max(rival.fitted.misfit for rival in rivals)
        return propose(
            self.lead,
            [rival_of(rival.names, rival.fitted) for rival in rivals],
            ground.white.sigma,
            discrepancy=float(np.sqrt(max(left**2 - 1.0, 0.0))),
            finer=ground.finer,
            cost=lambda twin: self._cost(twin, ground.white),
            config=self.config.experiment,
            simulations=self.simulations,
        )

    def _cost(self, twin: Twin, white: Whitener) -> float:
        """Squared whitened misfit on the training frames; infinite where the run cannot be trusted."""
        tracks = self.simulations.run([Job(twin, self.frames)])[0]
        return float("inf") if tracks is None else float(np.sum(white.residual(tracks) ** 2))

    def _rms(self, tracks: Array) -> float:
        """Root mean squared residual of the sightings per axis [m]."""
        seen = self.scene.visible[: self.frames]
        return float(np.sqrt(np.mean((tracks - self.scene.points[: self.frames])[seen] ** 2)))

    def _doubtful(self, twin: Twin, tracks: Array, sigma: float) -> list[Array]:
        """What an uncertain start and controllers that err do to the prediction, (frames, N, 3) each."""
        if len(self.recordings.fitted) > 1:
            return []
        return doubtful(self.simulations, self.lead, twin, tracks, sigma)


def _supported(known: list[Hypothesis], weights: Array, sigma: float) -> tuple[Supported, ...]:
    ordered = sorted(zip(weights, known, strict=True), key=lambda pair: -pair[0])
    return tuple(
        Supported(
            h.names,
            float(w),
            h.fitted.misfit,
            float(np.sqrt(h.left)),
            sigma * float(np.sqrt(max(h.left - 1.0, 0.0))),
        )
        for w, h in ordered
    )
