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

from physworld.calibrate.estimates import Estimate
from physworld.calibrate.global_stage import FitResult
from physworld.evaluate.numerics import REFINEMENT, refined
from physworld.scene import Scene

_ORDER = 2
_DOUBT = 0.5  # of the correction


def converged_parameters(
    scene: Scene,
    fitted: FitResult,
    particle_budget: int,
    refinement: float = REFINEMENT,
    poll: Callable[[int, int], None] | None = None,
) -> dict[str, Estimate]:
    """Estimates of the searched parameters without the error of the lattice.

    Args:
        scene: the recording; its training frames count.
        fitted: the calibration.
        particle_budget: the one that it was made with.
        refinement: cells of the finer lattice are this many times smaller.
        poll: called with (frames done, frames in all) of every run; may raise to stop.

    Raises:
        SimulationError: a run cannot be trusted.
    """
    end = scene.train[1]
    visible = scene.visible[:end]
    times, controls = scene.control_track()

    def predicted(twin) -> np.ndarray:
        nodes = twin.simulate_nodes(times, controls, scene.times[:end], progress=poll)
        return twin.observe(nodes, scene.times[:end])[visible].reshape(-1)

    base = fitted.tracks[:end][visible].reshape(-1)
    columns, theta = [], []
    for parameter in fitted.searched:
        now = parameter.searched(fitted.parameters[parameter.name].value)
        step = (
            parameter.step if now + parameter.step <= parameter.searched(parameter.high) else -parameter.step
        )
        columns.append((predicted(parameter.apply(fitted.twin, parameter.value(now + step))) - base) / step)
        theta.append(now)
    change = predicted(refined(scene, fitted.twin, particle_budget, refinement)) - base
    delta, *_ = np.linalg.lstsq(np.stack(columns, axis=1), change, rcond=None)
    correction = -delta / (1.0 - float(refinement) ** -_ORDER)
    found = {}
    for parameter, now, shift in zip(fitted.searched, theta, correction, strict=True):
        estimate = fitted.parameters[parameter.name]
        interval = None
        if estimate.ci95 is not None:
            low, high = (
                -np.inf if parameter.scale == "log" and end <= 0 else parameter.searched(end)
                for end in estimate.ci95
            )
            half = float(np.hypot(0.5 * (high - low), _DOUBT * shift))
            interval = (parameter.value(now + shift - half), parameter.value(now + shift + half))
        value = float(np.clip(parameter.value(now + shift), parameter.low, parameter.high))
        note = f"extrapolated to cells of no size; the twin's own lattice uses {estimate.value:.5g}"
        found[parameter.name] = Estimate(value, parameter.unit, interval, estimate.identified, note)
    return found
