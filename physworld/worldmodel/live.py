"""A world model that is stepped by hand: control velocities in, the object's vertices out, one tick at a time.

It is the rollout of ``rollout.rollout`` cut into single steps: positions are counted from the same origin in the same
precision, so that a session and a rollout under the same controllers agree to the last bit.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.dataset import graph_origin
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.published import PublishedModel


class LiveRollout:
    """The state of one session: the last h + 1 frames of all vertices, and where the controllers are."""

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
        self._published, spec = published, published.spec
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
        """Back to the start."""
        self.tick = 0
        self.controllers = self._first_controllers[-1].copy()
        driven = self._first_controllers[:, self._published.spec.control_index] - self._origin
        self._window = np.concatenate([self._first - self._origin, driven], axis=1).astype(np.float32)

    @property
    def vertices(self) -> Array:
        """Object vertices now [m], (n, 3)."""
        return self._window[-1, : self._published.spec.object_count].astype(np.float64) + self._origin

    def set_phi(self, phi: Array) -> None:
        """Give the body other properties from the next step on: logarithms of property ratios (n, 2).

        Raises GraphInvalid for another shape or values that are not finite; the properties are as before then.
        """
        given = np.asarray(phi, dtype=np.float64)
        if given.shape != self._phi.shape or not np.isfinite(given).all():
            raise GraphInvalid(f"phi of shape {given.shape}, not {self._phi.shape}, or not finite")
        self._phi = given

    def set_model(self, published: PublishedModel) -> None:
        """From the next step on the same network at other strengths (:meth:`PublishedModel.at_strengths`)."""
        self._published = published

    def step(self, controllers: Array) -> Array:
        """Move all controllers to (K, 3) [m] within one tick; the object vertices then, (n, 3) [m].

        Raises GraphInvalid for another shape or values that are not finite; nothing has moved then.
        """
        places = np.asarray(controllers, dtype=np.float64)
        if places.shape != self.controllers.shape or not np.isfinite(places).all():
            raise GraphInvalid(
                f"controllers of shape {places.shape} with {int(np.isfinite(places).sum())} finite values, "
                f"not {self.controllers.shape}"
            )
        spec, n = self._published.spec, self._published.spec.object_count
        following = (places[spec.control_index] - self._origin).astype(np.float32)
        driven = np.concatenate([self._window[:, n:], following[None]])
        path = self._published.engine.run(self._window[:, :n], driven, self._phi)
        self._window, self.controllers, self.tick = path[1:], places, self.tick + 1
        return self.vertices
