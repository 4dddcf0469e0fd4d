"""What both spring–mass baselines share in fitting: the loss, its descent by gradient, and the fitted model.

The loss is the mean distance of tracked points over the training frames, in open loop from the first one, smooth within
a millimetre. Nothing else of a recording is fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from physworld.arrays import Array
from physworld.baselines.spring_body import SpringBody, spring_body, springs_between
from physworld.baselines.spring_steps import Gradient, Run, Springs
from physworld.errors import CalibrationError, SceneUnsupported, SimulationError
from physworld.scene import Scene

SMOOTH_M = 1e-3
FACTOR = np.log(10.0)
"""A spring's stiffness and damping stay within this factor of where their descent began (logarithm)."""
_BETAS = (0.9, 0.99)


@dataclass(frozen=True)
class SpringSettings:
    """How a spring–mass baseline is fitted.

    Attributes:
        points: mass points of a solid, about.
        population, generations: of CMA-ES; every member is a simulation of the training frames.
        epochs: descents, each over all training frames.
        rate: of Adam, in logarithms.
        window_s: simulated time through which gradients pass [s].
        seed: of CMA-ES.
    """

    points: int = 300
    population: int = 8
    generations: int = 15
    epochs: int = 30
    rate: float = 0.1
    window_s: float = 0.1
    seed: int = 1


@dataclass(frozen=True)
class SpringModel:
    """A fitted network: it predicts any recording of the object.

    Attributes:
        springs: its network.
        points: how many mass points it joins.
        reach: longest spring over the body's spacing.
        most: neighbours of a point.
        settings: how it was fitted.
        simulations: of the training frames; a descent counts as one.
        loss_m: on the training frames [m].
        started_m: loss before the descent [m].
        seconds: that the fit took.
    """

    springs: Springs
    points: int
    reach: float
    most: int
    settings: SpringSettings
    simulations: int
    loss_m: float
    started_m: float
    seconds: float

    def __call__(self, scene: Scene) -> Array:
        """Tracked points (T, N, 3) [m] in open loop from the first frame.

        A body of as many mass points keeps the network spring by spring, its rest lengths too; another one is joined
        anew, with the mean numbers. Raises SceneUnsupported where a scene declares too little, SimulationError where
        steps would be too short.
        """
        body = spring_body(scene, self.settings.points)
        springs = self.springs
        if len(body.points) != self.points:
            even = network(body, self.reach, self.most)
            springs = replace(
                springs,
                pairs=even.pairs,
                rest=even.rest,
                stiffness=np.full(len(even.pairs), springs.stiffness.mean()),
                damping=np.full(len(even.pairs), springs.damping.mean()),
            )
        return Run(body, springs, self.settings.window_s).simulate(scene.times)

    def to_arrays(self) -> dict[str, Array]:
        """Everything as plain arrays, for an npz without pickle."""
        own = {
            f"springs.{field.name}": np.asarray(getattr(self.springs, field.name))
            for field in fields(Springs)
        }
        settings = {
            f"settings.{field.name}": np.asarray(getattr(self.settings, field.name))
            for field in fields(SpringSettings)
        }
        rest = {
            field.name: np.asarray(getattr(self, field.name))
            for field in fields(self)
            if field.name not in ("springs", "settings")
        }
        return own | settings | rest

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array]) -> SpringModel:
        """What ``to_arrays`` took apart. Raises KeyError for an array that is not there."""

        def read(kind: type, prefix: str, leave: tuple[str, ...] = ()) -> dict[str, object]:
            named = {
                field.name: arrays[f"{prefix}{field.name}"]
                for field in fields(kind)
                if field.name not in leave
            }
            return {name: of.item() if of.ndim == 0 else of for name, of in named.items()}

        return cls(
            springs=Springs(**read(Springs, "springs.")),  # type: ignore[arg-type]
            settings=SpringSettings(**read(SpringSettings, "settings.")),  # type: ignore[arg-type]
            **read(cls, "", ("springs", "settings")),  # type: ignore[arg-type]
        )


def network(body: SpringBody, reach: float, most: int) -> Springs:
    """Springs of stiffness and damping 1 between points within ``reach`` spacings, ``most`` a point; no drag."""
    pairs = springs_between(body.points, reach * body.spacing, most)
    rest = np.linalg.norm(body.points[pairs[:, 0]] - body.points[pairs[:, 1]], axis=1)
    zero = np.zeros(len(pairs))
    return Springs(pairs, rest, zero, zero, -20.0, np.array([0.0, 0.0, 0.0, 0.0, 0.0]))


class Fitting:
    """A scene's training frames, and how far a network is from them."""

    def __init__(self, scene: Scene, settings: SpringSettings) -> None:
        """Take the training frames.

        Args:
            scene: the recording.
            settings: of the fit.

        Raises:
            SceneUnsupported: training frames do not begin at the first one, or no point is seen after it.
        """
        first, last = scene.train
        if first > 0:
            raise SceneUnsupported(f"training frames begin at {first}; the springs start at frame 0")
        self.settings = settings
        self.body = spring_body(scene, settings.points)
        self._times = scene.times[:last]
        self._seen = np.array(scene.visible[:last], dtype=float)
        self._seen[0] = 0.0
        if not self._seen.any():
            raise SceneUnsupported(f"no point is seen in the {last} training frames after the first")
        self._goal = np.where(scene.visible[:last, :, None], scene.points[:last], 0.0)
        self._begun = time.perf_counter()
        self.simulations = 0

    def loss(self, springs: Springs) -> float:
        """Of a network [m]; infinite where it cannot be simulated."""
        self.simulations += 1
        try:
            tracks = Run(self.body, springs, self.settings.window_s).simulate(self._times)
        except SimulationError:
            return float("inf")
        return self._of(tracks)

    def slope(self, springs: Springs) -> tuple[float, Gradient]:
        """Loss [m] and its gradient by the logarithms of stiffness, damping and drag. May raise SimulationError."""
        self.simulations += 1
        total = self._seen.sum()

        def of_tracks(frames: Array, tracks: Array) -> Array:
            gap = tracks - self._goal[frames]
            size = np.sqrt(np.sum(gap**2, axis=-1) + SMOOTH_M**2)
            return np.asarray((self._seen[frames] / (total * size))[..., None] * gap)

        run = Run(self.body, springs, self.settings.window_s, gradient=True)
        tracks, gradient = run.descend(self._times, of_tracks)
        return self._of(tracks), gradient

    def descended(
        self, theta: Array, springs_of: Callable[[Array], Springs], pulled: Callable[[Gradient], Array]
    ) -> tuple[Array, float]:
        """The best numbers of ``settings.epochs`` steps of Adam, and their loss [m].

        Args:
            theta: where it begins, (p,), logarithms; they stay within ``FACTOR``.
            springs_of: the network of numbers.
            pulled: the gradient by the numbers of one by the springs.

        Raises:
            SimulationError: the beginning cannot be simulated.
        """
        start, best, least = theta, theta, float("inf")
        mean, square = np.zeros_like(theta), np.zeros_like(theta)
        for epoch in range(1, self.settings.epochs + 1):
            try:
                loss, gradient = self.slope(springs_of(theta))
            except SimulationError:
                if epoch == 1:
                    raise
                break
            if loss < least:
                best, least = theta, loss
            by_theta = pulled(gradient)
            if not np.isfinite(by_theta).all():
                break
            mean = _BETAS[0] * mean + (1.0 - _BETAS[0]) * by_theta
            square = _BETAS[1] * square + (1.0 - _BETAS[1]) * by_theta**2
            way = mean / (1.0 - _BETAS[0] ** epoch)
            size = np.sqrt(square / (1.0 - _BETAS[1] ** epoch))
            theta = theta - self.settings.rate * way / np.maximum(size, 1e-30)
            theta = np.clip(theta, start - FACTOR, start + FACTOR)
        last = self.loss(springs_of(theta))
        return (theta, last) if last < least else (best, least)

    def model(self, springs: Springs, reach: float, most: int, loss: float, started: float) -> SpringModel:
        """The fitted network.

        Args:
            springs: its network.
            reach: longest spring over the body's spacing.
            most: neighbours of a point.
            loss: on the training frames [m].
            started: loss before the descent [m].

        Raises:
            CalibrationError: no network could be simulated.
        """
        if not np.isfinite(loss):
            raise CalibrationError(f"none of {self.simulations} networks could be simulated")
        spent = time.perf_counter() - self._begun
        return SpringModel(
            springs, len(self.body.points), reach, most, self.settings, self.simulations, loss, started, spent
        )

    def _of(self, tracks: Array) -> float:
        gap = np.sqrt(np.sum((tracks - self._goal) ** 2, axis=-1) + SMOOTH_M**2) - SMOOTH_M
        loss = float(np.sum(np.where(self._seen > 0, gap, 0.0)) / self._seen.sum())
        return loss if np.isfinite(loss) else float("inf")
