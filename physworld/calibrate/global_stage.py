"""Global stage: homogeneous parameters of a twin, fitted to the training frames of a recording.

1. Scan the stiffness over its decades on a first window of frames, where phases have not slipped yet, and follow the
   three best starts there by Gauss-Newton.
2. Gauss-Newton on all training frames from the two best.
3. Free how a sheet bends, if that removes 10 % of the cost, or the fibres of a solid whose law has them.
   Then free optional parameters (drag, internal friction, Poisson's ratio, an undeclared ground's friction, the weave
   of a sheet whose law has one), the best one first. A screening by one run each skips those that
   cannot help to first order; of the others each must lower the training cost by more than 2 % (Poisson's ratio:
   15 %). After one that removed half of it, start again from a quarter and four times the stiffness: the first scan
   knew less. Drop again what the others made needless, also the yield of a flow law, which is searched with the
   stiffness from the first scan on.
4. Shift the tracked points in the body, those of a rope with its sections, by their mean residual (frame 0 is noisy
   too), clipped at 3 sigma; of a start as measured, whose first frame says less: :mod:`physworld.calibrate.places`.
5. Gauss-Newton again on all that were kept; hold at its prior what the data turn out not to fix; intervals and
   correlations from the sensitivities at the optimum, wider by what controllers and ends of the body may err by.

Only training frames enter. The simulation's budget counts every run. A search that it cut short at any step, in which
anything was left out for want of runs, has no intervals and did not converge. A journal of the finished steps makes it
resumable: see :mod:`physworld.estimation.journal`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.cloths import calibrate_cloth
from physworld.calibrate.descents import Descent, Optimum
from physworld.calibrate.estimates import (
    NOT_CONVERGED,
    UNIDENTIFIED_HALF_WIDTH,
    Correlations,
    Estimate,
    cut_short,
    estimates,
    held_at_priors,
)
from physworld.calibrate.fibres import free_fibres
from physworld.calibrate.local_stage import LocalResult
from physworld.calibrate.parameters import (
    Parameter,
    affordable,
    flow_law,
    hangs_taut,
    level,
    parameters_of,
    relaxing,
    release,
)
from physworld.calibrate.recordings import (
    Agreement,
    Recorded,
    SharedSearch,
    of_one_object,
    recorded,
    together,
)
from physworld.calibrate.rods import calibrate_rod
from physworld.calibrate.search import Progress, Search
from physworld.devices import default_device
from physworld.engine.thin.triangles import Mesh
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import Solution
from physworld.estimation.simulations import Runner, in_turn
from physworld.estimation.unknowns import LINEAR
from physworld.geometry.sheet_body import is_hung_sheet
from physworld.geometry.shown import misplaced
from physworld.materials.cable import CableLaw
from physworld.materials.library import with_law
from physworld.scene import Scene
from physworld.twin.build import build_twin, taken_over
from physworld.twin.twin import Twin

_LEAST_SCREENED = (
    0.1  # share of the gain that it needs which a parameter must show to first order to be tried
)
_LEAST_PROPORTIONAL = 0.5  # the same of one that acts in proportion
_RESTARTS = (0.25, 4.0)  # factors on the stiffness that is tried again once something else was freed
_RESTART_GAIN = 0.5  # share of the cost that this must have removed
_PROMISING = 4.0  # times the best cost: a restart that is worse after two steps is left
_KEPT_BACK = 12  # runs that the selection leaves for what follows
_NO_LOSS = 0.02  # relative rise of the training cost that holding a parameter at its prior may cause


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the global stage.

    Attributes:
        particle_budget: about how many particles a solid gets.
        max_simulations: at most this many runs over the training frames.
        device: Warp device of the simulations.
        damping: "auto" adds drag, internal friction and a frame out of level where the data ask; "none" keeps the
            declared physics only.
        bending: "auto" frees how a sheet bends where the data ask; "declared" keeps what its thickness says.
        law: name of the elastic law (:mod:`physworld.materials.library`); None for the shape's usual one.
        formulation: "auto", "total_lagrangian" or "updated_lagrangian": see :mod:`physworld.engine.formulations`.
        transfer: of the updated Lagrangian form, "apic" or "asflip".
        plasticity: name of the flow law (:mod:`physworld.materials.plastic`), whose yield is searched too; None for an
            elastic body.
        mesh: of a sheet, the mesh of triangles that recorded it (:mod:`physworld.engine.thin.triangles`); None for a
        plate.
        held: of a discrete rod, the numbers that are not searched and stay as the declared physics has them: names of
            :func:`physworld.calibrate.rods.rod_parameters`, or how they begin.
        placed: whether, of a start as measured, the training frames say where tracked points lie in the body
            (:mod:`physworld.calibrate.places`), or the first frame alone.
    """

    particle_budget: int = 2000
    max_simulations: int = 400
    device: str = field(default_factory=default_device)
    damping: Literal["auto", "none"] = "auto"
    bending: Literal["auto", "declared"] = "auto"
    law: str | None = None
    formulation: str = "auto"
    transfer: str = "apic"
    plasticity: str | None = None
    mesh: Mesh | None = None
    held: tuple[str, ...] = ()
    placed: bool = True


@dataclass(frozen=True)
class FitResult:
    """What a calibration found.

    Attributes:
        twin: with the calibrated parameters.
        parameters: estimates by name; what was searched first.
        searched: what was searched, in the order of ``correlations``.
        correlations: of the searched parameters.
        tracks: tracked points over all frames, open loop from the first, (T, N, 3) [m].
        particles: particles over all frames, (T, P, 3) [m].
        losses: the paper's loss and the noise-weighted misfit on the training frames.
        simulations: runs used.
        seconds: wall time.
        loss_history: root mean squared training residual after each run [m], best so far.
        cut_short: the budget of simulations ended the search before it ended by itself; there are no intervals then.
        open: what the search did not converge on, with the reason in words.
        rejected: parameters that were tried and not kept, with the share of the cost that they removed.
        local: what the local stage found, or None where it was not asked for; a field that it kept is the twin's.
        homogeneous: tracks of the twin without that field, (T, N, 3) [m]; None without one.
        recordings: of several recordings every one, the first too; empty for one.
        agreement: of several recordings, whether they agree on the object's numbers.
    """

    twin: Twin
    parameters: dict[str, Estimate]
    searched: tuple[Parameter, ...]
    correlations: Correlations
    tracks: Array
    particles: Array
    losses: dict[str, Any]
    simulations: int
    seconds: float
    loss_history: list[float]
    cut_short: bool = False
    open: dict[str, str] = field(default_factory=dict)
    rejected: dict[str, float] = field(default_factory=dict)
    local: LocalResult | None = None
    homogeneous: Array | None = None
    recordings: tuple[Recorded, ...] = ()
    agreement: tuple[Agreement, ...] = ()


def calibrate(
    scene: Scene | Sequence[Scene],
    config: CalibrationConfig | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> FitResult:
    """Fit a twin to the training frames of ``scene``.

    Args:
        scene: the recording, or several of one object (:mod:`physworld.calibrate.recordings`).
        config: settings; None for the defaults.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.
        journal: finished steps of an earlier attempt, which are not simulated again.
        runner: where simulations run that do not depend on each other.

    Raises:
        CalibrationError: no start gave a usable simulation.
        Cancelled: ``cancelled`` returned true.
        SceneUnsupported: the scene declares too little for a body, or recordings are not of one form of body.
        ValueError: there is no such law for the body, or no such flow law.
    """
    config = config or CalibrationConfig()
    started = time.perf_counter()
    scenes = [scene] if isinstance(scene, Scene) else list(scene)
    priors = of_one_object([prior_twin(known, config) for known in scenes])
    if priors[0].natural is not None:
        return calibrate_rod(scenes, priors, config, progress, cancelled, journal)
    if is_hung_sheet(scenes[0], config.mesh):
        return calibrate_cloth(scenes, priors, config, progress, cancelled, journal)
    search = _search(scenes, priors, config.max_simulations, progress, cancelled, journal, runner)
    parameters = together([searched_parameters(*of, config) for of in zip(scenes, priors, strict=True)])
    search.limit = config.max_simulations - min(_KEPT_BACK, config.max_simulations // 4)
    kept, optimum, rejected = select(search, parameters)
    search.limit = config.max_simulations - (len(kept) + 1 if config.max_simulations > _KEPT_BACK else 0)
    shifted = search.shift_points(kept, optimum.theta, config.placed)
    if shifted:
        optimum = search.solve(kept, optimum.theta, 5)
    search.limit = config.max_simulations
    kept, optimum, solution = _hold_the_unknown(search, kept, optimum, rejected)
    changes = search.mistaken(kept, optimum)
    if len(scenes) == 1:  # where clouds put ends errs otherwise in every recording, which is not counted
        changes = [*changes, *_misplaced(search, kept, optimum, config)]
    found, correlated = _estimates(search, kept, optimum, solution, changes)
    if search.cut_short:
        found = cut_short(found, config.max_simulations)
    left = config.placed and not shifted  # for want of simulations
    each = [recorded(known, search.at(kept, optimum.theta, k), left) for k, known in enumerate(scenes)]
    held = held_at_priors(scenes[0], each[0].twin, rejected, parameters)
    return FitResult(
        twin=each[0].twin,
        parameters={**found, **{name: e for name, e in held.items() if name not in found}},
        searched=tuple(kept),
        correlations=correlated,
        tracks=each[0].tracks,
        particles=each[0].particles,
        losses=each[0].losses,
        simulations=search.simulations,
        seconds=time.perf_counter() - started,
        loss_history=search.history,
        cut_short=search.cut_short,
        open={name: e.note for name, e in found.items() if search.cut_short or e.note in NOT_CONVERGED},
        rejected=rejected,
        recordings=tuple(each) if len(each) > 1 else (),
        agreement=() if solution is None or search.cut_short else search.agreement(kept, solution),
    )


def _search(scenes: list[Scene], priors: list[Twin], *settings: Any) -> Search:
    return (
        Search(scenes[0], priors[0], *settings)
        if len(scenes) == 1
        else SharedSearch(scenes, priors, *settings)
    )


def prior_twin(scene: Scene, config: CalibrationConfig) -> Twin:
    """The twin before its calibration, under the configured laws."""
    twin = build_twin(
        scene,
        config.particle_budget,
        config.device,
        plasticity=None if config.plasticity is None else flow_law(config.plasticity),
        formulation=config.formulation,
        transfer=config.transfer,
        mesh=config.mesh,
    )
    if config.law is None:
        return twin
    if (config.law == CableLaw.name) != (twin.natural is not None):
        raise ValueError(
            f"no law {config.law!r} for a body of the {twin.form.title} form: discrete rods have {CableLaw.name}"
        )
    return replace(twin, law=with_law(twin.law, config.law))


def searched_parameters(scene: Scene, twin: Twin, config: CalibrationConfig) -> list[Parameter]:
    """What may be searched in this scene."""
    found = parameters_of(
        twin,
        separate_bending=scene.body.thickness_m is None and scene.body.size_m is None,
        damping=config.damping == "auto",
        ground_friction=scene.ground is not None and scene.ground.friction is None,
        taut=hangs_taut(scene, twin),
    )
    found += release(twin, scene.times[: scene.train[1]])
    if config.damping == "auto":
        found += [*relaxing(twin, scene.times[: scene.train[1]]), *level(scene, twin)]
    return found if config.bending == "auto" else [p for p in found if p.stage != "shape"]


def select(search: Search, parameters: list[Parameter]) -> tuple[list[Parameter], Optimum, dict[str, float]]:
    """Steps 1 to 3: the parameters to keep, their optimum, and what the others would have removed."""
    kept = [p for p in parameters if p.stage in ("stiffness", "flow", "taut")]
    optimum = search.scan(kept)
    rejected: dict[str, float] = {}
    shape = [p for p in parameters if p.stage == "shape"]
    if shape:
        freed = _followed(
            search, [*kept, *shape], np.append(optimum.theta, [p.searched(p.starts[0]) for p in shape])
        )
        gain = 1.0 - freed.cost / optimum.cost
        if gain > min(p.least_gain for p in shape):
            kept, optimum = [*kept, *shape], freed
        else:
            rejected.update({p.name: gain for p in shape})
    kept, optimum, without = free_fibres(
        search, kept, optimum, [p for p in parameters if p.stage == "fibres"]
    )
    rejected.update(without)
    optional = [p for p in parameters if p.stage == "optional"]
    # those that act in proportion last: with most of the cost gone, every other one would promise a share of the rest
    for proportional in (False, True):
        asked = [p for p in optional if p.proportional is proportional]
        kept, optimum, without = free_optional(search, kept, optimum, asked)
        rejected.update(without)
    for needless in _groups(kept):
        others = [k for k, p in enumerate(kept) if p not in needless]
        trial = search.solve([kept[k] for k in others], optimum.theta[others], 2)
        if trial.cost * (1.0 - needless[0].least_gain) <= optimum.cost:
            rejected[needless[0].name] = 1.0 - optimum.cost / trial.cost
            kept, optimum = [kept[k] for k in others], trial
    return kept, optimum, rejected


def free_optional(
    search: Search, kept: list[Parameter], optimum: Optimum, candidates: list[Parameter]
) -> tuple[list[Parameter], Optimum, dict[str, float]]:
    """What of optional parameters the data ask for, the best first: those kept, their optimum, what others remove.

    Args:
        search: residuals of the twin.
        kept: what is searched already.
        optimum: its optimum, theta (p,) and cost [m^2].
        candidates: optional parameters.
    """
    twin = search.at(kept, optimum.theta)
    candidates = [affordable(search.scene, twin, p) for p in candidates]
    rejected: dict[str, float] = {}
    while candidates:
        screened = search.screen(kept, optimum, candidates)
        hopeful = [c for c in candidates if screened[c.name] >= _least_screened(c)]
        trials = search.solve_each(
            [Descent([*kept, c], np.append(optimum.theta, c.searched(c.starts[0])), 4) for c in hopeful]
        )
        gains = dict(screened)
        gains.update({c.name: 1.0 - t.cost / optimum.cost for c, t in zip(hopeful, trials, strict=True)})
        gains.update(
            {c.name: 0.0 for c, t in zip(hopeful, trials, strict=True) if _at_a_bound(c, t.theta[-1])}
        )
        # not a number: the budget ended
        enough = [k for k, c in enumerate(hopeful) if gains[c.name] > c.least_gain]
        if not enough:
            rejected.update({c.name: gains[c.name] for c in candidates})
            break
        best = max(enough, key=lambda k: gains[hopeful[k].name])
        kept, optimum = [*kept, hopeful[best]], trials[best]
        candidates.remove(hopeful[best])
        restarts = kept[0].stage == "stiffness" and not hopeful[best].proportional
        if restarts and gains[hopeful[best].name] > _RESTART_GAIN:
            optimum = _restarted(search, kept, optimum)
    return kept, optimum, rejected


def _least_screened(parameter: Parameter) -> float:
    share = _LEAST_PROPORTIONAL if parameter.proportional else _LEAST_SCREENED
    return share * parameter.least_gain


def _at_a_bound(parameter: Parameter, value: float) -> bool:
    """Whether one that acts in proportion went as far as it may: then it stands for something else."""
    return parameter.proportional and not parameter.bounds[0] < value < parameter.bounds[1]


def _groups(kept: list[Parameter]) -> list[list[Parameter]]:
    """What may turn out needless once others are free: every parameter but the stiffness by itself, fibres as one."""
    fibres = [p for p in kept if p.stage == "fibres"]
    alone = [[p] for p in kept if p.stage not in ("stiffness", "fibres")]
    return [*alone, fibres] if fibres else alone


def _followed(search: Search, parameters: list[Parameter], theta: Array) -> Optimum:
    """An optimum over a window that grows to all training frames: phases that slip make a long one's cost rugged."""
    window = search.first_window()
    for end, iterations in ((window, 4), ((window + search.end) // 2, 3)):
        theta = search.solve(parameters, theta, iterations, end).theta
    return search.solve(parameters, theta, 5)


def _restarted(search: Search, kept: list[Parameter], optimum: Optimum) -> Optimum:
    """The better of the optimum and of descents from other stiffnesses: the first scan knew less."""
    found = [optimum]
    for factor in _RESTARTS:
        theta = optimum.theta.copy()
        theta[0] = np.clip(theta[0] + np.log(factor), *kept[0].bounds)
        trial = search.solve(kept, theta, 2)
        if trial.cost < _PROMISING * optimum.cost:
            trial = search.solve(kept, trial.theta, 3)
        found.append(trial)
    return min(found, key=lambda o: o.cost if np.isfinite(o.cost) else np.inf)


def _hold_the_unknown(
    search: Search, kept: list[Parameter], optimum: Optimum, rejected: dict[str, float]
) -> tuple[list[Parameter], Optimum, Solution | None]:
    """Step 5: what the data do not fix goes back to its prior, if the training cost allows it.

    The last searched parameter stays: something has to be searched.
    """
    solution = search.linearise(kept, optimum)
    while solution is not None and len(kept) > 1:
        found, _ = _estimates(search, kept, optimum, solution)
        width = {
            p.name: (e.ci95 is None or _half_width(p, e) >= UNIDENTIFIED_HALF_WIDTH[p.transform.name])
            for p, e in ((p, found[p.name]) for p in kept)
        }
        unknown = [p for p in reversed(kept) if width[p.name] and p.name not in rejected]
        if not unknown:
            break
        loose = unknown[0]
        others = [k for k, p in enumerate(kept) if p is not loose]
        before = search.twins
        if loose.stage == "stiffness":
            search.twins = [loose.apply(twin, loose.starts[0]) for twin in before]
        trial = search.solve([kept[k] for k in others], optimum.theta[others], 3)
        rejected[loose.name] = 1.0 - optimum.cost / trial.cost
        if not trial.cost * (1.0 - _NO_LOSS) <= optimum.cost:
            search.twins = before
            del rejected[loose.name]
            break
        kept, optimum = [kept[k] for k in others], trial
        solution = search.linearise(kept, optimum)
    return kept, optimum, solution


def _misplaced(
    search: Search, kept: list[Parameter], optimum: Optimum, config: CalibrationConfig
) -> list[Array]:
    """Changes of the residual (m,) [m], one standard deviation each, by where the cloud of a first frame puts ends."""
    axes = search.twin.lattice.dim
    others = misplaced(search.scene, axes) if axes < 3 else []
    fitted = search.at(kept, optimum.theta)
    bodies = [prior_twin(scene, config) for scene in (search.scene, *others)] if others else []
    return search.elsewhere([taken_over(fitted, body) for body in bodies])


def _half_width(parameter: Parameter, estimate: Estimate) -> float:
    low, high = estimate.ci95 or (0.0, np.inf)
    if parameter.transform is LINEAR:
        return 0.5 * (high - low)
    return 0.5 * float(np.log(high / low)) if low > 0 else float("inf")


def _estimates(
    search: Search,
    kept: list[Parameter],
    optimum: Optimum,
    solution: Solution | None,
    changes: list[Array] | None = None,
) -> tuple[dict[str, Estimate], Correlations]:
    frames, points = search.frame_of_residual(search.end), search.point_of_residual()
    if solution is None:
        empty = Solution(
            optimum.theta, optimum.cost, np.zeros(len(frames)), np.zeros((len(frames), len(kept)))
        )
        return estimates(kept, empty, frames, points, measured=False)
    return estimates(kept, solution, frames, points, True, changes)
