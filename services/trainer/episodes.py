"""The episodes of a dataset as a training asks for them: by index, waiting for those that are still being made.

A training whose ``start_share`` is below 1 may begin while its dataset is being written. What is committed stays what
it is, so an episode may be read as soon as its row is there, checked against the digest in it. At the end the dataset
has to be sealed: a version names the digest of the data it learned from.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.config import StrengthRange
from physworld.demonstrate.perturbation import BOUND_SIGMAS
from physworld.worldmodel.dataset import VERTEX_ARRAYS, Track, has_vertices, read_track
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.model import PROPERTY_COUNT
from physworld_schemas.base import Reference
from physworld_schemas.dataset import Dataset, Episode
from physworld_storage import resources
from physworld_storage.errors import NotFound
from physworld_workers.context import TaskContext
from physworld_workers.errors import DatasetIncomplete
from physworld_workers.stores import Stores
from physworld_workers.tasks.dataset import demonstration_of

POLL_S = 0.5


def half(one: StrengthRange) -> float:
    """Half the width of a strength's interval."""
    return 0.5 * (one.high - one.low)


class Episodes:
    """Episodes of one dataset at the graph's vertices.

    Attributes:
        total: how many there are, or will be.
        strengths: of the trace's effects that the episodes differ in, with their intervals.
        friction: the ground's fitted coefficient where the episodes differ in it, else None.
        reached: steps taken and to take, for the progress while it waits.
    """

    def __init__(
        self,
        context: TaskContext,
        stores: Stores,
        dataset_id: str,
        spec: GraphSpec,
        history: int,
        strengths: Sequence[StrengthRange] = (),
        ground_friction: float | None = None,
    ) -> None:
        self._context, self._stores, self._dataset_id = context, stores, dataset_id
        self._spec, self._history = spec, history
        dataset = self._dataset()
        self.total = dataset.config.episodes
        perturbed = dataset.config.effects != "as_found"
        self.strengths = tuple(one for one in strengths if perturbed and one.low < one.high)
        demonstration = demonstration_of(dataset.config)
        self._friction_sigma = demonstration.sigma_of("friction")
        self._most_friction = min(BOUND_SIGMAS * self._friction_sigma, np.log(demonstration.largest_factor))
        self.friction = ground_friction if self._friction_sigma > 0.0 else None
        self.reached = (0, 1)

    def track(self, index: int) -> Track:
        """Episode ``index`` once it is there. Raises Cancelled, LeaseLost, DatasetIncomplete or EpisodeCorrupt."""
        while (episode := self._committed(index)) is None:
            if self._dataset().state in {"failed", "sealed"}:
                raise DatasetIncomplete(
                    f"dataset {self._dataset_id} ended without episode {index} of {self.total}"
                )
            self._wait(f"waiting for episode {index} of {self.total}")
        self._context.check()
        read = self._stores.episodes.verified
        arrays, attributes = read(episode.path, episode.digest, VERTEX_ARRAYS)
        if not has_vertices(self._spec, arrays):  # of an older release, or more vertices than were kept
            arrays, attributes = read(episode.path, episode.digest)
        drawn = attributes.get("effect_strengths", {})
        own = [
            (drawn.get(f"{one.effect}.{one.name}", one.value) - one.value) / half(one)
            for one in self.strengths
        ]
        if (
            self.friction is not None and arrays["properties"].shape[1] == PROPERTY_COUNT
        ):  # one factor for all of it
            drawn_friction = attributes.get("parameters", {}).get("ground_friction", self.friction)
            own.insert(0, float(np.log(drawn_friction / self.friction)))
        return read_track(self._spec, arrays, self._history, np.array(own))

    def bounds(self) -> Array:
        """Ends of what fine-tuning may choose: of log(μ/μ_fit), if the episodes differ in it, and of the strengths'
        intervals as distances from the estimates in half-widths, (m, 2)."""
        ends = [[(end - one.value) / half(one) for end in (one.low, one.high)] for one in self.strengths]
        if self.friction is not None:
            ends.insert(0, [-self._most_friction, self._most_friction])
        return np.array(ends).reshape(-1, 2)

    def tuned(self, found: Array) -> dict[str, Any]:
        """What fine-tuning chose (m,) of :meth:`bounds`, in physical units beside what the calibration said."""
        values, said = list(found), {}
        if self.friction is not None:
            most = float(np.exp(self._most_friction))
            said["ground.friction"] = {
                "calibrated": self.friction,
                "bounds": [self.friction / most, self.friction * most],
                "tuned": self.friction * float(np.exp(values.pop(0))),
            }
        for one, value in zip(self.strengths, values, strict=True):
            said[f"{one.effect}.{one.name}"] = {
                "calibrated": one.value,
                "ci95": [one.low, one.high],
                "tuned": one.value + half(one) * float(value),
            }
        return said

    def description(self) -> dict[str, Any]:
        """What the dataset says of itself: kinds of motion, lengths, settings; the limits of what was learned."""
        dataset = self._dataset()
        return {"statistics": dataset.statistics, "config": dataset.config.model_dump(mode="json")}

    def sealed(self) -> Reference:
        """The dataset with its digest, once it is sealed. Raises Cancelled, LeaseLost or DatasetIncomplete."""
        while (dataset := self._dataset()).digest is None:
            if dataset.state == "failed":
                raise DatasetIncomplete(
                    f"dataset {self._dataset_id} failed: there is nothing to name as its origin"
                )
            self._wait("waiting for the dataset's seal")
        return Reference(kind="dataset", id=dataset.id, digest=dataset.digest)

    def _wait(self, message: str) -> None:
        self._context.check()
        self._context.progress(*self.reached, "steps", message)
        time.sleep(POLL_S)

    def _dataset(self) -> Dataset:
        with self._stores.database.reading() as session:
            return resources.get_dataset(session, self._dataset_id)

    def _committed(self, index: int) -> Episode | None:
        with self._stores.database.reading() as session:
            try:
                return resources.get_episode(session, self._dataset_id, index)
            except NotFound:
                return None
