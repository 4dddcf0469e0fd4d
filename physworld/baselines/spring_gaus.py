"""A volumetric mass–spring system as Spring-Gaus's (Zhong et al. 2024, arXiv:2403.09434), without its Gaussians.

Every mass point is joined to its nearest ones; a stiffness and a damping of its own are learned at each by gradients.
A spring takes the geometric mean of its ends, which keeps momentum. There is no air drag and no search of global
numbers: the publication starts from one stiffness for all objects; here the best of a few decades, which is more than
it has. Grips hold the material that the scene declares (the publication has a ground alone), and tracked points give
the loss instead of pictures. Steps as in :mod:`physworld.baselines.spring_steps`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.baselines.spring_fit import Fitting, SpringModel, SpringSettings, network
from physworld.baselines.spring_steps import Gradient, Springs
from physworld.scene import Scene

NEIGHBOURS = 24
REACH = 3.5  # of the spacing: far enough for all of them
STIFFNESS = tuple(10.0 ** (0.5 * step) for step in range(2, 11))  # [m/s²]
DAMPING_SHARE = 5e-3  # of the root of the stiffness [1/s]
_NO_GROUND = np.array(
    [0.1, 0.5, 0.0, 0.0, 0.0]
)  # elasticity and friction at a ground, the body passes through itself


def fit_spring_gaus(scene: Scene, settings: SpringSettings | None = None) -> SpringModel:
    """The system fitted to the training frames of ``scene``; what is returned predicts any recording of that object.

    Raises:
        SceneUnsupported: the scene declares too little for a body, or rigid bodies push it.
        CalibrationError: no network could be simulated.
    """
    settings = settings or SpringSettings()
    fitting = Fitting(scene, settings)
    bare = replace(network(fitting.body, REACH, NEIGHBOURS), collision=_NO_GROUND)
    count = len(fitting.body.points)

    def springs_of(theta: Array) -> Springs:
        at_ends = theta.reshape(2, count)[:, bare.pairs].mean(axis=2)
        return replace(bare, stiffness=at_ends[0], damping=at_ends[1])

    def pulled(slope: Gradient) -> Array:
        by_point = np.zeros((2, count))
        for end in (0, 1):
            for row, own in enumerate((slope.stiffness, slope.damping)):
                np.add.at(by_point[row], bare.pairs[:, end], 0.5 * own)
        return by_point.ravel()

    starts = [
        np.repeat([math.log(y), math.log(DAMPING_SHARE * math.sqrt(y) / fitting.body.spacing)], count)
        for y in STIFFNESS
    ]
    losses = [fitting.loss(springs_of(theta)) for theta in starts]
    started = min(losses)
    if not math.isfinite(started):
        return fitting.model(bare, REACH, NEIGHBOURS, started, started)
    theta, loss = fitting.descended(starts[losses.index(started)], springs_of, pulled)
    return fitting.model(springs_of(theta), REACH, NEIGHBOURS, loss, started)
