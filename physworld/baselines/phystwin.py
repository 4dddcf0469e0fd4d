"""A spring–mass twin as PhysTwin's (Jiang et al. 2025, arXiv:2503.17973), without its images.

Mass points joined by springs within a radius, at most so many a point; dashpots, air drag, and impulses in collisions
(:mod:`physworld.baselines.spring_steps`). Fitted in two stages to the training frames:

1. CMA-ES over global numbers: stiffness, dashpot, drag, radius, most neighbours; elasticity and friction at a
   ground where the scene has one; those of the body against itself, and its distance, where it touches itself.
2. Gradients by ``wp.Tape``: the stiffness of every spring.

What differs from the publication: grips hold the material that the scene declares, instead of springs to tracked hands;
points follow their correspondences, so the loss has no Chamfer part; gradients pass through 0.1 s and are gathered over
all training frames for a step; the step is as long as the springs allow, not shorter than theirs of 5e-5 s.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.baselines.spring_body import SpringBody
from physworld.baselines.spring_fit import Fitting, SpringModel, SpringSettings, network
from physworld.baselines.spring_steps import Springs
from physworld.errors import CalibrationError
from physworld.scene import Scene

_REFUSED = 1e3  # loss [m] of what cannot be simulated: CMA-ES ranks, and knows no infinity


@dataclass(frozen=True)
class Number:
    """One of the search: its bounds, and whether it is searched by its logarithm."""

    low: float
    high: float
    logarithmic: bool = True

    def at(self, share: float) -> float:
        """Between the bounds, ``share`` in [0, 1]."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return self.low + share * (self.high - self.low)


NUMBERS = {
    "stiffness": Number(1e1, 1e6),  # [m/s²]
    "damping": Number(1e-2, 1e3),  # [1/s]
    "drag": Number(1e-3, 2e1),  # [1/s]
    "reach": Number(1.05, 3.5, False),  # of the spacing
    "most": Number(12, 40, False),
}
AT_GROUND = {"ground_elasticity": Number(0.0, 1.0, False), "ground_friction": Number(0.0, 2.0, False)}
AT_ITSELF = {
    "own_elasticity": Number(0.0, 1.0, False),
    "own_friction": Number(0.0, 2.0, False),
    "own_distance": Number(0.1, 1.0, False),  # of the spacing
}


def fit_phystwin(scene: Scene, settings: SpringSettings | None = None) -> SpringModel:
    """The twin fitted to the training frames of ``scene``; what is returned predicts any recording of that object.

    Raises:
        SceneUnsupported: the scene declares too little for a body, or rigid bodies push it.
        CalibrationError: no network could be simulated, or the package ``cma`` is not installed.
    """
    settings = settings or SpringSettings()
    fitting = Fitting(scene, settings)
    numbers = searched(fitting.body)
    found = _search(fitting, numbers, settings)
    even = springs_of(fitting.body, found)
    started = fitting.loss(even)
    if not math.isfinite(started):
        raise CalibrationError(f"none of {fitting.simulations} networks could be simulated")
    theta, loss = fitting.descended(
        even.stiffness, lambda stiffness: replace(even, stiffness=stiffness), lambda slope: slope.stiffness
    )
    springs = replace(even, stiffness=theta)
    return fitting.model(springs, found["reach"], round(found["most"]), loss, started)


def searched(body: SpringBody) -> dict[str, Number]:
    """What the search goes over for a body."""
    ground = AT_GROUND if body.ground is not None else {}
    return NUMBERS | ground | (AT_ITSELF if body.touches_itself else {})


def springs_of(body: SpringBody, numbers: dict[str, float]) -> Springs:
    """The network of global numbers, as ``searched`` lists them."""
    even = network(body, numbers["reach"], round(numbers["most"]))
    collision = [numbers.get(name, 0.0) for name in (*AT_GROUND, *AT_ITSELF)]
    collision[-1] *= body.spacing
    return replace(
        even,
        stiffness=even.stiffness + math.log(numbers["stiffness"]),
        damping=even.damping + math.log(numbers["damping"]),
        drag=math.log(numbers["drag"]),
        collision=np.array(collision),
    )


def _search(fitting: Fitting, numbers: dict[str, Number], settings: SpringSettings) -> dict[str, float]:
    """The best numbers of CMA-ES (Hansen 2016) over their shares."""
    try:
        import cma
    except ImportError as error:
        raise CalibrationError("the search needs the package cma (pip install physworld[bench])") from error

    def at(shares: Array) -> dict[str, float]:
        return {name: of.at(share) for (name, of), share in zip(numbers.items(), shares, strict=True)}

    options = {
        "bounds": [0.0, 1.0], "popsize": settings.population, "maxiter": settings.generations,
        "seed": settings.seed, "verbose": -9, "verb_log": 0,
    }  # fmt: skip
    best, least = np.full(len(numbers), 0.5), float("inf")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of equal losses, where a generation cannot be simulated
        search = cma.CMAEvolutionStrategy(len(numbers) * [0.5], 0.25, options)
        while not search.stop():
            asked = search.ask()
            losses = [min(fitting.loss(springs_of(fitting.body, at(shares))), _REFUSED) for shares in asked]
            search.tell(asked, losses)
            if min(losses) < least:
                best, least = asked[int(np.argmin(losses))], min(losses)
    return at(best)
