"""The search for fibres in a solid whose law has them: their modulus, and a direction that no descent finds from afar.

The isotropic optimum lies between the stiffness along the fibres and that of the matrix. Weak and strong fibres along
13 directions (edges, diagonals of the faces, diagonals of a cube) are tried over a first window of frames. From the
five best the two moduli descend there, from the three best of these the direction too, and from the two best of these
all four numbers over all training frames. The best one is kept if it removes a tenth of the training cost. Else there
are no fibres, as their prior says.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.descents import Descent, Optimum, cost_of
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.search import Search

_RATIOS = (1.0, 4.0)  # of the fibres' modulus to the matrix's, where a descent may start
_TRIED, _TURNED, _FOLLOWED = (
    5,
    3,
    2,
)  # starts whose moduli, whose direction, and that over all frames, are searched


def directions() -> Array:
    """Unit vectors (13, 3) along edges and diagonals of a cube, one of every two that are opposite."""
    found = [v for v in product((-1, 0, 1), repeat=3) if v > (0, 0, 0)]
    vectors = np.array(found, dtype=float)
    units: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return units


def angles_of(vector: Array) -> tuple[float, float]:
    """Azimuth and elevation [rad] of a unit vector (3,)."""
    return float(np.arctan2(vector[1], vector[0])), float(np.arcsin(np.clip(vector[2], -1.0, 1.0)))


def free_fibres(
    search: Search, kept: list[Parameter], optimum: Optimum, fibres: list[Parameter]
) -> tuple[list[Parameter], Optimum, dict[str, float]]:
    """Fibres, if the data ask for them.

    Args:
        search: residuals of a twin whose law has fibres.
        kept: what is searched already, Young's modulus first.
        optimum: its optimum.
        fibres: modulus, azimuth and elevation; none for a law without.

    Returns:
        What is searched now, its optimum, and where fibres were not kept the share of the cost that they remove.
    """
    if not fibres:
        return kept, optimum, {}
    modulus, together, window = fibres[0], [*kept, *fibres], search.first_window()
    starts = _starts(kept, optimum, fibres)
    costs = search.costs("scan " + " ".join(p.name for p in fibres), together, starts, window)
    usable = sorted(
        (cost, tuple(start)) for cost, start in zip(costs, starts, strict=True) if cost is not None
    )
    straight = [_along(search, kept, fibres, np.array(start), window) for _, start in usable[:_TRIED]]
    straight.sort(key=cost_of)
    turned = search.solve_each([Descent(together, one.theta, 4, window) for one in straight[:_TURNED]])
    turned.sort(key=cost_of)
    late = search.solve_each([Descent(together, one.theta, 3) for one in turned[:_FOLLOWED]])
    if not late:
        return kept, optimum, {modulus.name: float("nan")}
    best = min(late, key=cost_of)
    best = search.solve(together, best.theta, 5)
    gain = 1.0 - best.cost / optimum.cost
    if not gain > modulus.least_gain:  # also where the budget ended
        return kept, optimum, {modulus.name: gain}
    return together, best, {}


def _starts(kept: list[Parameter], optimum: Optimum, fibres: list[Parameter]) -> list[Array]:
    """Where the searched numbers may start, every direction after the other."""
    modulus = fibres[0]
    found = []
    for vector in directions():
        for ratio in _RATIOS:
            theta = optimum.theta.copy()
            theta[0] -= 0.5 * np.log1p(
                ratio
            )  # half way from what was found to the matrix of fibres in its place
            young = kept[0].value(float(np.clip(theta[0], *kept[0].bounds)))
            strength = float(np.clip(ratio * young, modulus.low, modulus.high))
            found.append(np.concatenate([theta, [modulus.searched(strength), *angles_of(vector)]]))
    return found


def _along(
    search: Search, kept: list[Parameter], fibres: list[Parameter], theta: Array, window: int
) -> Optimum:
    """The optimum over the window with the fibres' direction as it is; all numbers are in its theta."""
    modulus, *angles = fibres
    before = search.twins
    for angle, value in zip(angles, theta[-len(angles) :], strict=True):
        search.twins = [angle.apply(twin, float(value)) for twin in search.twins]
    found = search.solve([*kept, modulus], theta[: -len(angles)], 3, window)
    search.twins = before
    return Optimum(np.concatenate([found.theta, theta[-len(angles) :]]), found.cost)
