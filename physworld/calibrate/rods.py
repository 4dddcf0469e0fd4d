"""Calibration of discrete rods: all of a rod's numbers at once, each with a prior, over windows of frames that grow.

    minimise  sum r^2 / (n_c sigma^2)  +  sum ((theta - mean) / deviation)^2

r are the residuals of the tracked points on the training frames. sigma is what the model leaves of them, found as it
goes on (the tracking noise at least); neighbouring frames err alike, so that n_c of them, those within 2 sqrt(L / g),
count as one. Nothing is selected: a number that the data do not ask for stays near its prior, and the report says so.

1. Stiffness, internal friction and drag from several starts, over the first frames.
2. All unknowns, Gauss-Newton, over 17, 43, 71 and 100 % of the training frames (of a body that is driven from inside,
   since the first step): a window that grows finds the basin that all frames at once miss. All frames again as long as
   sigma falls.

Of several recordings of one object (:mod:`physworld.calibrate.recordings`) sigma and n_c are each one's own, and so is
its window.

A launch integrates a twin and what differs from it by one step in each number, side by side; it is counted as one
simulation. Priors: curvature of its own as of a coil of some windings, torsion of a round section, air drag of ropes
and foam rods in air, friction and creep small.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.estimates import (
    RATIO_NOTE,
    UNIDENTIFIED_HALF_WIDTH,
    Correlations,
    Estimate,
)
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.recordings import Agreement, recorded, together, twin_at
from physworld.calibrate.rod_parameters import DRIVE, GRAVITY, LOSSES, rod_parameters, steps_seen
from physworld.calibrate.rod_recordings import SharedRodSearch, of_a_recording, require_alike
from physworld.calibrate.rod_search import Progress, RodSearch, off_priors
from physworld.errors import CalibrationError
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import correlations
from physworld.estimation.unknowns import LINEAR
from physworld.scene import Scene
from physworld.twin.twin import Twin

if TYPE_CHECKING:
    from physworld.calibrate.global_stage import CalibrationConfig, FitResult

_STARTS = (5e-4, 2e-3, 8e-3, 3e-2, 0.2, 1.5)  # of rho A g L^3: bending stiffnesses that hang visibly
_STIFF_STARTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # of what rings by itself: denser, for its phase
_FIRST = ("bending_n_m2", "relaxation_s", "air_drag_per_s")
_FIRST_STEPS, _STEPS = 5, 8
_AGAIN, _STEADY = (
    6,
    0.95,
)  # descents on all frames while what is left of them still falls to less than this share
_Z95 = 1.96


def calibrate_rod(
    scenes: Sequence[Scene],
    twins: Sequence[Twin],
    config: CalibrationConfig,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    journal: Journal | None,
) -> FitResult:
    """Fit a discrete rod to the training frames of recordings; see the module's text.

    Args:
        scenes: the recordings.
        twins: of each, with prior numbers.
        config: settings; ``max_simulations`` counts launches, ``damping`` "none" frees no friction, drag or creep.
        progress: called with (launches done, launches at most, message).
        cancelled: polled before every launch.
        journal: finished steps of an earlier attempt.

    Raises:
        CalibrationError: no start gave a usable simulation.
        Cancelled: ``cancelled`` returned true.
    """
    from physworld.calibrate.global_stage import FitResult

    begun = time.perf_counter()
    pairs = [(known, _driven(known, twin)) for known, twin in zip(scenes, twins, strict=True)]
    require_alike(twins)
    parts = [RodSearch(*pair, config.max_simulations, progress, cancelled) for pair in pairs]
    search = parts[0] if len(parts) == 1 else SharedRodSearch(parts)
    journal = journal or Journal()
    held = (*config.held, *(LOSSES if config.damping == "none" else ()))
    unknowns = together(
        [[u for u in rod_parameters(*pair) if not u.name.startswith(held)] for pair in pairs], of_a_recording
    )
    ends = search.windows

    def step(name: str, compute: Callable[[], tuple[Array, float]]) -> tuple[Array, float]:
        def counted() -> dict[str, Any]:
            theta, cost = compute()
            return {"theta": theta.tolist(), "cost": cost, "simulations": search.simulations, "sigma": search.left,
                    "history": list(search.history), "cut_short": search.cut_short}  # fmt: skip

        kept = journal.step(name, counted)
        search.simulations, search.left = kept["simulations"], kept["sigma"]
        search.history, search.cut_short = list(kept["history"]), kept["cut_short"]
        return np.array(kept["theta"]), float("inf") if kept["cost"] is None else float(kept["cost"])

    first = [u for u in unknowns if u.name in _FIRST or DRIVE in u.name]
    theta, cost = step("rod scan", lambda: _scan(search, first, ends[:2]))
    if not np.isfinite(cost):
        raise CalibrationError(
            f"none of {len(_STARTS)} starts of the bending stiffness gave a usable simulation of {search.end} frames"
        )
    theta = np.array([theta[first.index(u)] if u in first else u.start for u in unknowns])
    for number, end in enumerate([*ends, *ends[-1:] * _AGAIN]):
        before = np.array(search.left)

        def descend(place: Array = theta, end: int = end) -> tuple[Array, float]:
            found, cost = search.descend(unknowns, place, end, _STEPS)
            search.settle(unknowns, found, end)
            return found, cost

        theta, cost = step(f"rod window {number}", descend)
        if number >= len(ends) and np.all(np.array(search.left) > _STEADY * before):
            break
    found, correlated, agreement = _estimates(search, unknowns, theta)
    each = [
        recorded(part.scene, twin_at(part.twin, unknowns, theta, k), config.placed)
        for k, part in enumerate(parts)
    ]
    return FitResult(
        twin=each[0].twin,
        parameters={**found, "density": _density(scenes[0], each[0].twin)},
        searched=tuple(unknowns),
        correlations=correlated,
        tracks=each[0].tracks,
        particles=each[0].particles,
        losses=each[0].losses,
        simulations=search.simulations,
        seconds=time.perf_counter() - begun,
        loss_history=list(np.minimum.accumulate(search.history)) if search.history else [],
        cut_short=search.cut_short,
        open={name: e.note for name, e in found.items() if search.cut_short},
        recordings=tuple(each) if len(each) > 1 else (),
        agreement=agreement,
    )


def _scan(search: RodSearch, first: list[Parameter], ends: list[int]) -> tuple[Array, float]:
    """The best of descents from several stiffnesses over the first windows."""
    twin = search.twin
    weight = twin.density * GRAVITY * float(twin.lattice.distances.max()) ** 3  # type: ignore[attr-defined]
    found = []
    for share in _STARTS if twin.drive is None else _STIFF_STARTS:
        theta = np.array([np.log(share * weight) if u.name == _FIRST[0] else u.start for u in first])
        cost = np.inf
        for end in ends:
            theta, now = search.descend(first, theta, end, _FIRST_STEPS)
            cost = now if np.isfinite(now) else cost  # the budget may not reach a longer window
        found.append((cost, tuple(theta)))
    cost, best = min(found)
    return np.array(best), cost


def _estimates(
    search: RodSearch, unknowns: list[Parameter], theta: Array
) -> tuple[dict[str, Estimate], Correlations, tuple[Agreement, ...]]:
    """Numbers with the intervals of the posterior's Gaussian about its mode, and whether recordings agree on them."""
    names = tuple(u.name for u in unknowns)
    residual, jacobian = search.linearised(unknowns, theta, search.end)
    _, prior = off_priors(unknowns, theta)
    covariance: Array = np.diag(1.0 / prior**2)
    agreement: tuple[Agreement, ...] = ()
    if residual is not None and jacobian is not None:
        agreement = () if search.cut_short else search.agreement(unknowns, theta, residual, jacobian)
        weight = 1.0 / (search.sigma**2 * search.together)
        covariance = np.linalg.inv(weight * jacobian.T @ jacobian + np.diag(prior**2))
    found = {}
    for k, unknown in enumerate(unknowns):
        half = _Z95 * float(np.sqrt(covariance[k, k]))
        known = half < 0.5 * _Z95 / prior[k]
        sure = bool(known and (unknown.transform is LINEAR or half < UNIDENTIFIED_HALF_WIDTH["log"]))
        ends = (unknown.value(theta[k] - half), unknown.value(theta[k] + half))
        note = "" if sure else "the data say little beyond its prior"
        if search.cut_short or residual is None:
            note = f"the search was cut short by its budget of {search.limit} simulations: no interval"
            found[unknown.name] = Estimate(unknown.value(float(theta[k])), unknown.unit, None, False, note)
            continue
        found[unknown.name] = Estimate(unknown.value(float(theta[k])), unknown.unit, ends, sure, note)
    return found, Correlations(names, correlations(covariance)), agreement


def _driven(scene: Scene, twin: Twin) -> Twin:
    return twin if twin.drive is not None else replace(twin, drive=steps_seen(scene))


def _density(scene: Scene, twin: Twin) -> Estimate:
    declared = scene.body.density_kg_m3 is not None or scene.body.mass_kg is not None
    return Estimate(
        twin.density, "kg/m", None, False, f"{'as declared' if declared else 'prior'}; {RATIO_NOTE}"
    )
