"""How much internal friction a fit can wait for.

Friction that is proportional to stiffness damps the lattice's fastest motions most, and an explicit step has to
resolve that: beyond a point the stable time step is inversely proportional to it. A recording shows nothing of these
motions. So the search ends where that step is ``SLOWEST`` times smaller than without friction; a value found there is
reported to be at the bound of its search. Beyond it a run takes sub-steps of friction
(:mod:`physworld.engine.total.relaxation`) and twice the time and more.
"""

from __future__ import annotations

from dataclasses import replace

from scipy.optimize import brentq

from physworld.calibrate.parameters import Parameter
from physworld.engine.total.formulation import TotalLagrangian
from physworld.scene import Scene
from physworld.twin.twin import Twin

SLOWEST = 8.0  # times
_NAMES = ("relaxation_s", "viscosity_pa_s")
_CLOSE = 0.05  # in the logarithm


def affordable(scene: Scene, twin: Twin, parameter: Parameter) -> Parameter:
    """The parameter with the upper bound that ``twin``, otherwise at its optimum, can be simulated at.

    Parameters other than internal friction, and twins of the updated Lagrangian form, keep theirs.
    """
    if parameter.name not in _NAMES or twin.form.on_particles:
        return parameter
    controls = scene.control_track()

    def step_s(changed: Twin) -> float:
        run = changed.integration(*controls, scene.times)
        return float(TotalLagrangian(run.problem).steps.explicit_s())

    least_s = step_s(parameter.apply(twin, parameter.held)) / SLOWEST

    def spare(searched: float) -> float:
        return step_s(parameter.at(twin, searched)) / least_s - 1.0

    low, high = parameter.bounds
    if spare(high) >= 0.0:
        return parameter
    high = brentq(spare, low, high, xtol=_CLOSE) if spare(low) > 0.0 else low + _CLOSE
    starts = tuple(float(min(value, parameter.value(0.5 * (low + high)))) for value in parameter.starts)
    return replace(parameter, high=parameter.value(high), starts=starts)
