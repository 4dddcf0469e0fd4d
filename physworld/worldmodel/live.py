"""A world model that is stepped by hand: control velocities in, the object's vertices out, one tick at a time.

It is the rollout of ``rollout.rollout`` cut into single steps: positions are counted from the same origin in the same
precision, so that a session and a rollout under the same controllers agree to the last bit.

A version that was published with models for other sets of grips can let go and take hold again, as in
``physworld.worldmodel.holding.rollout``. The controllers of a grip that was opened go along with the material that it
held; it closes where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.dataset import graph_origin
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.holding.spans import Grips, every_grip
from physworld.worldmodel.holding.taking import taken_hold, vertices_near
from physworld.worldmodel.published import PublishedModel


@dataclass(frozen=True)
class _Opened:
    """A grip that let go: when; its controllers (k,), and where they were then [m], (k, 3); vertices (m,) beside it."""

    tick: int
    own: Array
    hand: Array
    near: Array


class LiveRollout:
    """The state of one session: the last h + 1 frames of all vertices, and where the controllers are.

    Attributes:
        own: grips that hold at the start, those of the model itself.
        holding: grips that hold now.
        tick: steps since the start.
    """

    def __init__(
        self,
        published: PublishedModel,
        *,
        phi: Array | None = None,
        history: Array | None = None,
        controllers: Array | None = None,
    ) -> None:
        """From the recording's start.

        Args:
            published: the model.
            phi: logarithms of property ratios (n, 2); None is as published.
            history: object vertices of the first frames (h+1, n, 3) [m]; None is the recording's start.
            controllers: in those frames (h+1, K, 3) [m]; None is the recording's start.

        Raises:
            GraphInvalid: other shapes than these.
        """
        spec = published.spec
        self.own: Grips = _grips_of(published)
        self._models = {_grips_of(one): one for one in (published, *published.others)}
        self._phi = published.phi if phi is None else np.asarray(phi, dtype=np.float64)
        self._first = np.array(published.start_history if history is None else history, dtype=np.float64)
        driven = published.start_controllers if controllers is None else controllers
        self._first_controllers = np.array(driven, dtype=np.float64)
        expected = published.start_history.shape, published.start_controllers.shape, (spec.object_count, 2)
        given = self._first.shape, self._first_controllers.shape, self._phi.shape
        if given != expected:
            raise GraphInvalid(f"history, controllers and phi of shapes {given}, not {expected}")
        self._origin = graph_origin(spec, self._first[-1])
        self.reset()

    def reset(self) -> None:
        """Back to the start, where the grips of the model itself hold."""
        self.tick, self.holding = 0, self.own
        self._opened: dict[int, _Opened] = {}
        self._path = (self._first - self._origin).astype(np.float32)
        self._driven = self._first_controllers.copy()

    @property
    def controllers(self) -> Array:
        """All controllers now [m], (K, 3)."""
        places: Array = self._driven[-1]
        return places

    @property
    def sets(self) -> list[Grips]:
        """The sets of grips that can hold."""
        return sorted(self._models)

    @property
    def vertices(self) -> Array:
        """Object vertices now [m], (n, 3)."""
        places: Array = self._path[-1].astype(np.float64) + self._origin
        return places

    def set_phi(self, phi: Array) -> None:
        """Give the body other properties from the next step on: logarithms of property ratios (n, 2).

        Raises GraphInvalid for another shape or values that are not finite; the properties are as before then.
        """
        given = np.asarray(phi, dtype=np.float64)
        if given.shape != self._phi.shape or not np.isfinite(given).all():
            raise GraphInvalid(f"phi of shape {given.shape}, not {self._phi.shape}, or not finite")
        self._phi = given

    def set_model(self, published: PublishedModel) -> None:
        """From the next step on the same network at other strengths (:meth:`PublishedModel.at_strengths`); those of
        other sets of grips stay as they are."""
        self._models[self.own] = published

    def hold(self, grips: Sequence[int]) -> None:
        """From the next step on exactly these grips hold, by their numbers.

        Raises GraphInvalid where there is no model for them; nothing has changed then.
        """
        wanted = tuple(sorted({*grips}))
        if wanted not in self._models:
            known = ", ".join(str(list(one)) for one in self.sets)
            raise GraphInvalid(f"grips {list(wanted)} are to hold; there are world models of {known}")
        opened = {grip: since for grip, since in self._opened.items() if grip not in wanted}
        model = self._models[self.own]
        for grip in sorted(set(self.holding) - set(wanted)):
            own = np.array(model.grips[grip])
            near = vertices_near(model.spec, self._first[0], self._first_controllers[0, own])
            opened[grip] = _Opened(self.tick, own, self.controllers[own], near)
        self._opened, self.holding = opened, wanted

    def step(self, controllers: Array) -> Array:
        """Move all controllers to (K, 3) [m] within one tick, but those of grips that were opened, which go along with
        the material; the object vertices then, (n, 3) [m].

        Raises GraphInvalid for another shape or values that are not finite; nothing has moved then.
        """
        places = np.asarray(controllers, dtype=np.float64)
        if places.shape != self.controllers.shape or not np.isfinite(places).all():
            raise GraphInvalid(
                f"controllers of shape {places.shape} with {int(np.isfinite(places).sum())} finite values, "
                f"not {self.controllers.shape}"
            )
        model = self._models[self.holding]
        self._driven = np.concatenate([self._driven, places[None]])
        driven = (self._driven[:, model.spec.control_index] - self._origin).astype(np.float32)
        self._path = model.engine.run(self._path, driven, self._phi)[1:, : model.spec.object_count]
        self._driven, self.tick = self._driven[1:], self.tick + 1
        self._carry()
        return self.vertices

    def _carry(self) -> None:
        """Take the controllers of opened grips along with the material, in all frames of the window since then."""
        for grip in self._opened.values():
            frames = min(self.tick - grip.tick, len(self._path))
            path = self._path[-frames:, grip.near].astype(np.float64) + self._origin
            path = np.concatenate([self._first[:1, grip.near], path])
            if np.isfinite(path).all():
                hand = np.stack([self._first_controllers[0, grip.own], *[grip.hand] * frames])
                self._driven[-frames:, grip.own] = taken_hold(path, hand, 0)


def _grips_of(published: PublishedModel) -> Grips:
    """The grips that hold in a version."""
    return every_grip(len(published.grips)) if published.holding is None else published.holding
