"""What the calibrated numbers would be with cells of no size: a run on a finer lattice, extrapolated (Richardson).

A calibrated number makes up for the discretisation's own error: a coarse beam is a little too stiff, so its modulus
comes out a little too low. Let d be the change of the predicted tracks when the cells shrink by r, and J the
sensitivities at the optimum; the finer lattice then predicts what the coarser one did at theta - delta with

    delta = argmin |J delta - d|        theta_converged = theta - delta / (1 - r^-2)

for a scheme of second order. The correction's own doubt is taken as half of it, added in squares to the interval:
the twin keeps the numbers of its own lattice, which predict best there; these are the material's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.estimates import Estimate
from physworld.calibrate.global_stage import FitResult
from physworld.estimation.simulations import Drive, Job, Runner, in_turn
from physworld.estimation.unknowns import LOG
from physworld.evaluate.numerics import REFINEMENT, refined, trusted_tracks
from physworld.scene import Scene

_ORDER = 2
_DOUBT = 0.5  # of the correction


def converged_parameters(
    scene: Scene,
    fitted: FitResult,
    particle_budget: int,
    refinement: float = REFINEMENT,
    poll: Callable[[int, int], None] | None = None,
    runner: Runner = in_turn,
    finer_tracks: Array | None = None,
) -> dict[str, Estimate]:
    """Estimates of the searched parameters without the error of the lattice.

    Args:
        scene: the recording, of several the first; its training frames count.
        fitted: the calibration.
        particle_budget: the one that it was made with.
        refinement: cells of the finer lattice are this many times smaller.
        poll: called with numbers between runs and frames; may raise to stop.
        runner: where the runs go, which do not depend on each other.
        finer_tracks: what the twin on the finer lattice predicts, (T, N, 3) [m], where that is known already.

    Raises:
        SimulationError: a run cannot be trusted.
    """
    end = scene.train[1]
    visible = scene.visible[:end]
    places = []
    for parameter in fitted.searched:
        if parameter.recording:  # of another recording than the first, whose tracks these are
            continue
        now = parameter.searched(fitted.parameters[parameter.name].value)
        below = now + parameter.step > parameter.bounds[1]
        places.append((parameter, now, -parameter.step if below else parameter.step))
    jobs = {f"another {p.name}": Job(p.at(fitted.twin, now + step), end) for p, now, step in places}
    if finer_tracks is None:
        jobs["finer cells"] = Job(refined(scene, fitted.twin, particle_budget, refinement), end)
    tracks = trusted_tracks(jobs, Drive(*scene.control_track(), scene.times), poll, runner)
    finer = tracks.pop() if finer_tracks is None else finer_tracks[:end]
    base = fitted.tracks[:end][visible].reshape(-1)
    columns = [
        (found[visible].reshape(-1) - base) / step for found, (_, _, step) in zip(tracks, places, strict=True)
    ]
    change = finer[visible].reshape(-1) - base
    delta, *_ = np.linalg.lstsq(np.stack(columns, axis=1), change, rcond=None)
    correction = -delta / (1.0 - float(refinement) ** -_ORDER)
    found = {}
    for (parameter, now, _), shift in zip(places, correction, strict=True):
        estimate = fitted.parameters[parameter.name]
        interval = None
        if estimate.ci95 is not None:
            low, high = (
                -np.inf if parameter.transform is LOG and end <= 0 else parameter.searched(end)
                for end in estimate.ci95
            )
            half = float(np.hypot(0.5 * (high - low), _DOUBT * shift))
            interval = (parameter.value(now + shift - half), parameter.value(now + shift + half))
        value = float(np.clip(parameter.value(now + shift), parameter.low, parameter.high))
        note = f"extrapolated to cells of no size; the twin's own lattice uses {estimate.value:.5g}"
        found[parameter.name] = Estimate(value, parameter.unit, interval, estimate.identified, note)
    return found
