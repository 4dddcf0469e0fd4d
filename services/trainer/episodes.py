"""The episodes of a dataset as a training asks for them: by index, waiting for those that are still being made.

A training whose ``start_share`` is below 1 may begin while its dataset is being written. What is committed stays what
it is, so an episode may be read as soon as its row is there, checked against the digest in it. At the end the dataset
has to be sealed: a version names the digest of the data it learned from.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from physworld.demonstrate.config import StrengthRange
from physworld.demonstrate.perturbation import BOUND_SIGMAS
from physworld.worldmodel.dataset import VERTEX_ARRAYS, Track, has_vertices
from physworld.worldmodel.holding.spans import Grips, every_grip, held_tracks
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.properties import FRICTION, PROPERTIES, PhiColumn
from physworld_schemas.base import Reference
from physworld_schemas.dataset import Dataset, Episode
from physworld_storage import resources
from physworld_storage.errors import NotFound
from physworld_workers.context import TaskContext
from physworld_workers.errors import DatasetIncomplete
from physworld_workers.stores import Stores
from physworld_workers.tasks.dataset import demonstration_of

POLL_S = 0.5


def column_of(one: StrengthRange, unit: str = "") -> PhiColumn:
    """A strength as a column of Φ: its distance from the estimate in half-widths of its interval."""
    half = 0.5 * (one.high - one.low)
    return PhiColumn(
        name=f"{one.effect}.{one.name}",
        unit=unit,
        logarithmic=False,
        shared=True,
        calibrated=one.value,
        half_width=half,
        limits=((one.low - one.value) / half, (one.high - one.value) / half),
    )


class Episodes:
    """Episodes of one dataset at the graph's vertices.

    Attributes:
        total: how many there are, or will be.
        columns: of Φ: the properties, the ground's friction and the effects' strengths if the episodes differ in them.
        grip_count: G, of the twin.
        grips: that hold in the parts of the episodes that are read.
        lets_go: whether an episode that was read says which grips hold, so that parts of it are learned from.
        reached: steps taken and to take, for the progress while it waits.

    Args:
        context: of the shard: cancellation and progress while it waits.
        stores: hold the episodes.
        dataset_id: which may still be written.
        spec: the graph, whose vertices are read.
        history: h: frames before the present one that a step sees.
        strengths: intervals of the twin's effects, of which each becomes a column of Φ.
        ground_friction: calibrated coefficient; None without a ground.
        units: of the strengths, by the names of their columns.
        grip_count: G.
        grips: that hold; None: all.
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
        units: Mapping[str, str] | None = None,
        grip_count: int = 0,
        grips: Grips | None = None,
    ) -> None:
        self._context, self._stores, self._dataset_id = context, stores, dataset_id
        self._spec, self._history = spec, history
        self.grip_count, self.grips = grip_count, every_grip(grip_count) if grips is None else grips
        dataset = self._dataset()
        self.total = dataset.config.episodes
        perturbed = dataset.config.effects != "as_found"
        varied = [one for one in strengths if perturbed and one.low < one.high]
        self._intervals = {column_of(one).name: (one.low, one.high) for one in varied}
        units = units or {}
        demonstration = demonstration_of(dataset.config)
        sigma = demonstration.sigma_of("friction")
        friction: tuple[PhiColumn, ...] = ()
        if sigma > 0.0 and ground_friction is not None:
            most = min(BOUND_SIGMAS * sigma, float(np.log(demonstration.largest_factor)))
            friction = (
                PhiColumn(FRICTION, "1", shared=True, calibrated=ground_friction, limits=(-most, most)),
            )
        own = (column_of(one, units.get(f"{one.effect}.{one.name}", "")) for one in varied)
        self.columns = (*PROPERTIES, *friction, *own)
        self.reached = (0, 1)
        self.lets_go = False

    def tracks(self, index: int) -> list[Track]:
        """The parts of episode ``index`` in which exactly the grips hold, once it is there.

        Raises:
            Cancelled, LeaseLost, DatasetIncomplete, EpisodeCorrupt, DatasetUnusable: what stands in the way.
        """
        while (episode := self._committed(index)) is None:
            if self._dataset().state in {"failed", "cancelled", "sealed"}:
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
        if (friction := attributes.get("parameters", {}).get("ground_friction")) is not None:
            drawn = drawn | {FRICTION: friction}  # one factor for all of it, unless the episode holds a field
        values = {
            one.name: one.column_of(drawn.get(one.name, one.calibrated))
            for one in self.columns
            if one.calibrated is not None
        }
        self.lets_go |= "holding" in arrays
        own = (self.grips, self.grip_count, self._history)
        return held_tracks(self._spec, arrays, *own, self.columns, values)

    def tuned(self, strengths: Mapping[str, float]) -> dict[str, Any]:
        """What fine-tuning chose of the shared columns, in physical units beside what the calibration said."""
        said: dict[str, Any] = {}
        for one in self.columns:
            if one.calibrated is None or one.limits is None:
                continue
            said[one.name] = {"calibrated": one.calibrated, "tuned": one.quantity_of(strengths[one.name])}
            if one.logarithmic:
                most = float(np.exp(one.limits[1]))
                said[one.name]["bounds"] = [one.calibrated / most, one.calibrated * most]
            else:
                said[one.name]["ci95"] = list(self._intervals[one.name])
        return said

    def description(self) -> dict[str, Any]:
        """What the dataset says of itself: kinds of motion, lengths, settings; the limits of what was learned."""
        dataset = self._dataset()
        return {"statistics": dataset.statistics, "config": dataset.config.model_dump(mode="json")}

    def sealed(self) -> Reference:
        """The dataset with its digest, once it is sealed. Raises Cancelled, LeaseLost or DatasetIncomplete."""
        while (dataset := self._dataset()).digest is None:
            if dataset.state in {"failed", "cancelled"}:
                raise DatasetIncomplete(
                    f"dataset {self._dataset_id} {dataset.state}: there is nothing to name as its origin"
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
