"""``python -m benchmarks.trace.check_trials [--json FILE] [--refits N] [--seeds N] [--docs FILE]``: is a check right?

A bar that a grip shakes is checked before any fit. Then what the check foretells is done, by other code:

- *Intervals.* Bodies are drawn about the one that was checked, by three foretold deviations in every number, recorded
  with noise and refitted with the full simulator (:func:`physworld.estimation.refit.refit`). The refits' errors over
  the foretold deviations have to have the size 1.
- *Detection.* Recordings with an effect of so many times its detectable strength are refitted with the declared
  physics, and the effect is screened by a marginal likelihood
  (:mod:`benchmarks.trace.marginal`), which integrates a discrepancy out and has the search's bounds for a
  prior. It has to be found always at twice the detectable strength, never at a tenth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

from benchmarks.harness import Report, write_json, write_section
from benchmarks.trace.marginal import marginal
from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig
from physworld.check import CheckConfig, CheckResult, check
from physworld.check.information import POSTERIOR
from physworld.check.physics import Physics, declared_physics
from physworld.check.recorded import Recorded, recorded
from physworld.estimation.left_out import Linear
from physworld.estimation.refit import Refit, prior_rows, refit
from physworld.estimation.simulations import Drive, Simulations
from physworld.estimation.unknowns import at, bounds_of, starts_of
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.trace.candidates import Candidate, candidates
from physworld.trace.sensitivity import candidate_responses

STIFFNESS_PA, FRAMES, FPS = 6e4, 30, 30.0
SIGMA_M, FINE_M = 5e-4, 1e-4  # noises
EFFECTS = ("air_drag_linear", "viscosity_kelvin_voigt", "actuation_lag", "gravity_tilt")
MULTIPLES = (0.1, 0.5, 1.0, 2.0)
_ITERATIONS, _AGAIN = 4, 3
_NEAR = 3.0  # foretold deviations by which bodies differ
_KNOWN = 0.5  # ratio to the prior below which a number counts as known by the recording
CONFIG = CheckConfig(
    calibration=CalibrationConfig(particle_budget=60, damping="none"),
    values={"youngs_modulus_pa": STIFFNESS_PA},
    motions=0,
)


def bar(sigma_m: float = SIGMA_M) -> Scene:
    """A soft bar of 0.16 m whose grip goes up and down and aside; ten points with this noise [m], nothing measured yet.

    The grip holds the lower half of its section, softly: a clamp's reach has a kink, which no spread of refits follows.
    """
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.0)])
    points = np.array([[x, y, 0.015] for x in np.linspace(0.05, 0.16, 5) for y in (-0.015, 0.015)])
    times = np.arange(FRAMES) / FPS
    sway = 0.02 * np.stack([np.zeros(FRAMES), np.sin(9.0 * times), 1.0 - np.cos(7.0 * times)], axis=1)
    return Scene(
        name="bar",
        kind="beam",
        points=np.repeat(points[None], FRAMES, axis=0),
        visible=np.ones((FRAMES, len(points)), dtype=bool),
        controllers=grip + sway[:, None],
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=sigma_m,
        train=(0, FRAMES),
        test=(FRAMES, FRAMES),
        fps=FPS,
        initial_state=UNDEFORMED_AT_REST,
        body=Body(box_min_m=low, box_max_m=high, density_kg_m3=500.0),
        grips=(Grip((0, 1, 2, 3), low, np.array([0.03, 0.015, 0.0])),),
    )


@dataclass(frozen=True)
class Fitted:
    """A recording with the declared physics refitted to it.

    ``error``: of the refit over the foretold deviations, (p,).
    """

    physics: Physics
    simulations: Simulations
    made: Recorded
    refit: Refit
    error: Array


def ratios(told: CheckResult) -> Array:
    """Of the intervals after and before a calibration, of every number that is varied, (p,)."""
    return np.array([told.perfect.parameter(unknown.name).ratio for unknown in told.physics.probed])


def foretold(told: CheckResult) -> Array:
    """Deviations of the numbers after a calibration, in the scale of the search, (p,)."""
    unknowns = told.physics.unknowns
    return np.array(
        [u.prior[1] * f.ratio for u, f in zip(unknowns, told.perfect.parameters, strict=True) if u.prior]
    )


def fitted(
    scene: Scene, told: CheckResult, seed: int, acts: tuple[Candidate, Sequence[float]] | None = None
) -> Fitted:
    """A body near the one that was checked, recorded with noise, and refitted.

    Args:
        scene: the motion.
        told: by the check.
        seed: of body and noise.
        acts: an effect that acts too, with the strength of each gate in its unit.
    """
    rng = np.random.default_rng(seed)
    true, deviations = told.physics, foretold(told)
    unknowns = list(true.unknowns)
    low, high = bounds_of(unknowns)
    theta = starts_of(unknowns) + _NEAR * deviations * rng.normal(size=len(unknowns))
    theta = np.clip(theta, low, high)
    twin = at(true.twin, unknowns, theta)
    if acts is not None:
        candidate, strengths = acts
        twin = candidate.prepared(twin)
        for gate, strength in zip(candidate.unknowns(), strengths, strict=True):
            twin = gate.apply(twin, strength)
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noisy = replace(scene, points=tracks + rng.normal(scale=scene.noise_sigma_m or 0.0, size=tracks.shape))
    physics = declared_physics(noisy, CONFIG.calibration, CONFIG.values)
    simulations = Simulations(Drive(*noisy.control_track(), noisy.times))
    made = recorded(simulations, noisy, physics.twin, None, CONFIG.discrepancy_share)
    found, own = None, list(physics.stepped(ratios(told)).unknowns)
    for _ in range(
        _AGAIN
    ):  # a refit ends where a step gains little of the cost, which may be a deviation away
        found = refit(simulations, made.white, physics.twin, own, made.frames, _ITERATIONS)
        if found is None:
            raise RuntimeError(f"the bar of seed {seed} cannot be refitted")
        own = found.unknowns
    assert found is not None
    return Fitted(physics, simulations, made, found, (found.theta - theta) / deviations)


def spread_of(scene: Scene, told: CheckResult, refits: int) -> dict[str, Array]:
    """Errors of refits over the foretold deviation, (refits,), of every number that the recording knows.

    Args:
        scene: the motion.
        told: by the check.
        refits: of bodies and noise with the seeds from 0.
    """
    errors = np.array([fitted(scene, told, seed).error for seed in range(refits)])
    known = [(k, f.name) for k, f in enumerate(told.perfect.parameters) if f.ratio < _KNOWN]
    return {name: errors[:, k] for k, name in known}


def screened(of: Fitted, candidate: Candidate, library: int) -> bool:
    """Whether a trace's marginal likelihood gives the effect its posterior against the declared physics.

    Args:
        of: a refitted recording.
        candidate: the effect.
        library: effects that are asked.
    """
    known, refitted = of.made, of.refit
    (response,) = candidate_responses(
        of.simulations, known.white, refitted.twin, refitted.tracks, [candidate], known.frames
    )
    gates = candidate.unknowns()
    unknowns = [*refitted.unknowns, *gates]
    start = np.concatenate([refitted.theta, np.zeros(len(gates))])
    jacobian = np.concatenate([refitted.jacobian, response.columns], axis=1)
    off, slope = prior_rows(unknowns, start)
    low, high = bounds_of(unknowns)
    rows, target = np.concatenate([jacobian, slope]), np.concatenate([refitted.residual, off])
    scale = np.linalg.norm(rows, axis=0)
    ends = np.minimum(low - start, 0.0) * scale, np.maximum(high - start, 1e-9) * scale
    change = lsq_linear(rows / scale, target, ends, method="bvls").x / scale
    theta = start + change
    there = [unknown.starting(t) for unknown, t in zip(unknowns, theta, strict=True)]
    after, _ = marginal(
        Linear(refitted.residual - jacobian @ change, jacobian, there, theta), known.discrepancy
    )
    own = Linear(refitted.residual, refitted.jacobian, refitted.unknowns, refitted.theta)
    before, _ = marginal(own, known.discrepancy)
    return bool(after - before - np.log(2.0 * library) > np.log(POSTERIOR / (1.0 - POSTERIOR)))


def detection(
    scene: Scene, told: CheckResult, effect: str, multiples: Sequence[float], seeds: int
) -> dict[float, float]:
    """Share of recordings in which an effect's first gate, alone, is found, by its multiple of the detectable strength.

    Args:
        scene: the motion.
        told: by the check.
        effect: name in the registry.
        multiples: of the detectable strength.
        seeds: recordings at each.
    """
    candidate = candidates(told.physics.twin, (effect,))[0][0]
    figure = told.perfect.effect(_label(told, effect))
    rates = {}
    for multiple in multiples:
        strengths = [multiple * figure.gates[0].detectable, *(0.0 for _ in figure.gates[1:])]
        rates[multiple] = float(
            np.mean(
                [
                    screened(
                        fitted(scene, told, 1000 + s, (candidate, strengths)), candidate, len(told.asked)
                    )
                    for s in range(seeds)
                ]
            )
        )
    return rates


def main(arguments: list[str] | None = None) -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.check_trials")
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--refits", type=int, default=40, help="at each noise")
    parser.add_argument("--seeds", type=int, default=10, help="recordings at each strength")
    parser.add_argument("--docs", type=Path, default=None, help="page whose section is written anew")
    given = parser.parse_args(arguments)
    spreads = {}
    for sigma in (FINE_M, SIGMA_M):
        told = check(bar(sigma), CONFIG)
        spreads[sigma] = spread_of(bar(sigma), told, given.refits)
    rates = {name: detection(bar(), told, name, MULTIPLES, given.seeds) for name in EFFECTS}
    report = summary(told, spreads, rates, given.refits, given.seeds)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)


def summary(
    told: CheckResult,
    spreads: dict[float, dict[str, Array]],
    rates: dict[str, dict[float, float]],
    refits: int,
    seeds: int,
) -> Report:
    """The figures and a table.

    Args:
        told: by the check under the larger noise.
        spreads: of refits by noise [m].
        rates: of detection by effect and multiple.
        refits, seeds: how many.
    """
    gates = {
        name: told.perfect.effect(label).gates[0] for name, label in ((n, _label(told, n)) for n in rates)
    }
    sizes = {
        f"{1e3 * sigma:g} mm": {name: float(np.sqrt(np.mean(z**2))) for name, z in own.items()}
        for sigma, own in spreads.items()
    }
    rows = [
        (f"{name}, noise {noise}", "error of refits over the foretold deviation", f"{size:.2f}")
        for noise, own in sizes.items()
        for name, size in own.items()
    ]
    for name, own in rates.items():
        gate, at_each = gates[name], ", ".join(f"{multiple:g}" for multiple in own)
        what = f"found at {at_each} of {gate.detectable:.3g} {gate.unit}"
        rows.append((name, what, ", ".join(f"{rate:.0%}" for rate in own.values())))
    return Report(
        name="trace.check_trials",
        title="Against refits and screenings",
        figures={
            "size": sizes,
            "found": {n: {f"{m:g}": r for m, r in own.items()} for n, own in rates.items()},
        },
        header=("number or effect", "what was done", "found"),
        rows=rows,
        notes=(
            f"{refits} refits at each noise: sampling error {np.sqrt(0.5 / refits):.2f}",
            f"{seeds} recordings at each strength, noise {1e3 * SIGMA_M:g} mm",
        ),
    )


def _label(told: CheckResult, effect: str) -> str:
    """Of an effect's first part."""
    return next(figure.label for figure in told.perfect.effects if figure.effect == effect)


if __name__ == "__main__":
    main()
