"""Import of HDF5 files and MCAP logs, which their libraries parse in a child process."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.library import parsed
from physworld_scenes.importers.tables.arrays import table_of
from physworld_scenes.importers.tables.table import (
    MarkerTable,
    RigidBody,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    named,
    refused,
    shortened,
)


def read_hdf5(data: bytes, where: str) -> MarkerTable:
    """The tracks in an HDF5 file. Raises SceneInvalid."""
    arrays, _ = parsed("hdf5", data, where)
    return table_of(where, "HDF5", arrays)


def read_mcap(data: bytes, where: str) -> MarkerTable:
    """The poses and points in an MCAP log, on the clock of the topic with the most points; the others are interpolated.

    Raises:
        SceneInvalid: it holds neither, or a topic whose clock goes back.
    """
    arrays, facts = parsed("mcap", data, where)
    topics: list[str] = facts["topics"]
    left: dict[str, str] = facts["left"]
    if not topics:
        held = ", ".join(f"{shortened(topic)} ({shortened(kind)})" for topic, kind in list(left.items())[:8])
        raise refused(where, f"holds no poses and no points; its topics are {held or 'none'}")
    counts = [arrays[f"{n}.places"].shape[1] for n in range(len(topics))]
    leader = max(range(len(topics)), key=lambda n: (counts[n], len(arrays[f"{n}.times"])))
    clock = checked_times(f"{where} {shortened(topics[leader])}", arrays[f"{leader}.times"])
    checked_size(where, len(clock), sum(counts))
    labels: list[str] = []
    places: list[Array] = []
    bodies = []
    said = (
        [f"topics left out: {named([f'{topic} ({kind})' for topic, kind in left.items()])}"] if left else []
    )
    for number, topic in enumerate(topics):
        own, track = arrays[f"{number}.times"], arrays[f"{number}.places"]
        if number != leader:
            own = checked_times(f"{where} {shortened(topic)}", own)
            track, outside = _at(clock, own, track)
            exact = int(np.isin(clock, own).sum())
            said.append(
                f"{topic}: {len(own)} messages, interpolated at {len(clock) - exact - outside} of {len(clock)} frames"
            )
        labels += [topic] if track.shape[1] == 1 else [f"{topic}:{index}" for index in range(track.shape[1])]
        places.append(track)
        if f"{number}.turns" in arrays:
            bodies.append(
                _body(where, topic, clock, arrays[f"{number}.times"], track[:, 0], arrays[f"{number}.turns"])
            )
    names = checked_labels(where, labels)
    joined, seen, zeros = checked_places(where, names, np.concatenate(places, axis=1))
    return MarkerTable(
        form="MCAP",
        labels=names,
        places=joined,
        seen=seen,
        times=clock,
        unit="m",
        unit_from="ROS messages are in metres",
        up="z",
        up_from="convention of ROS",
        sets={t: tuple(f"{t}:{i}" for i in range(c)) for t, c in zip(topics, counts, strict=True) if c > 1},
        bodies=tuple(bodies),
        lines=tuple(said + zeros),
    )


def _at(clock: Array, own: Array, track: Array) -> tuple[Array, int]:
    """A track (M, P, 3) at other times, nan outside of its own; and how many times those are."""
    flat = track.reshape(len(own), -1)
    inside = (clock >= own[0]) & (clock <= own[-1])
    there = np.stack([np.interp(clock, own, flat[:, column]) for column in range(flat.shape[1])], axis=1)
    there[~inside] = np.nan
    return there.reshape(len(clock), *track.shape[1:]), int((~inside).sum())


def _body(where: str, name: str, clock: Array, own: Array, places: Array, turns: Array) -> RigidBody:
    length = np.linalg.norm(turns, axis=1)
    if not (np.abs(length - 1.0) <= 1e-2).all():
        at = int(np.argmax(~(np.abs(length - 1.0) <= 1e-2)))
        raise refused(
            where, f"the quaternion of {shortened(name)} has length {length[at]:.4g} in message {at}, not 1"
        )
    turns = turns / length[:, None]
    flips = np.cumprod(np.where(np.sum(turns[1:] * turns[:-1], axis=1) < 0.0, -1.0, 1.0))
    turns = turns * np.concatenate([[1.0], flips])[:, None]
    if len(own) != len(clock) or not np.array_equal(own, clock):
        turns = np.stack([np.interp(clock, own, turns[:, column]) for column in range(4)], axis=1)
        turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    seen: Array = np.asarray(np.isfinite(places).all(axis=1))
    return RigidBody(name, np.where(seen[:, None], places, 0.0), turns, seen)
