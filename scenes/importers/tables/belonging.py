"""Which markers belong to the body and which to what holds it: as a person says, as the file says, or by rigidity.

Markers that keep their distances while others do not are rigid together. One such group is the gripper; where all
markers are in such groups and one of them stays where it is, that one is the clamp. Anything else has to be said.
"""

from __future__ import annotations

import fnmatch
import re
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.options import GAUSSIAN_MAD, THIRD_DIFFERENCE_GAIN
from physworld_scenes.importers.tables.table import (
    UNLABELLED,
    MarkerTable,
    RigidBody,
    named,
    refused,
    shortened,
)

GRIPPER_NAME = re.compile(
    r"^(base|clamp|ctrl|control|grip|robot|tool|tcp|effector|end[ _]?effector|fixture)", re.IGNORECASE
)
"""Of a label behind its group, of a group, or of a rigid body."""
SAMPLED_FRAMES = 240
MOST_COMPARED = 600
LEAST_GROUP = 3
RIGID_SHARE = 1e-3
"""Of the distance of two markers, by which it may change while they are rigid together."""
RIGID_SIGMAS = 5.0
LINE_SHARE = 0.05
"""Second extent of a group over its first, up to which it is a line."""
DEFORMING_FACTOR = 5.0
"""By which a rigid pair's distance changes less than the usual pair's."""


@dataclass(frozen=True)
class Belonging:
    """Who is what, as indices into the table's markers.

    Attributes:
        gripper: markers that drive; ``bodies``: rigid bodies that do so by their poses.
        body: markers on the object, in the order in which they shall be.
        dropped: markers that nobody named, left out.
        gripper_how, body_how: where that is from.
    """

    gripper: tuple[int, ...]
    bodies: tuple[RigidBody, ...]
    body: tuple[int, ...]
    dropped: tuple[int, ...]
    gripper_how: str
    body_how: str


def belonging(
    table: MarkerTable, where: str, gripper: tuple[str, ...] | None, body: tuple[str, ...] | None
) -> Belonging:
    """Sort the markers.

    Args:
        table: the file's tracks.
        where: the file's name, in errors.
        gripper: names of markers, groups or rigid bodies that hold the object, with * for any letters; ('none',):
            nothing does.
        body: likewise of those on the object.

    Raises:
        SceneInvalid: a name that there is not, or nothing tells what holds the object.
    """
    unlabelled = tuple(i for i, label in enumerate(table.labels) if UNLABELLED.match(_short(label)))
    said_body = None if body is None else _chosen(table, where, body, "body")[0]
    kept = [i for i in range(len(table.labels)) if i not in set(unlabelled)]
    if said_body is not None:
        kept = sorted({*kept, *said_body})
    bodies: tuple[RigidBody, ...] = ()
    if gripper is not None and [name.lower() for name in gripper] == ["none"]:
        held: list[int] = []
        how = "given"
    elif gripper is not None:
        held, bodies = _chosen(table, where, gripper, "gripper")
        how = "given"
    else:
        held, bodies, how = _guessed(table, where, kept, said_body)
    taken = set(held)
    if said_body is not None:
        on_body, body_how = said_body, "given"
    else:
        inside = {
            table.labels.index(label)
            for one in bodies
            for label in (*table.sets.get(one.name, ()), one.name)
            if label in table.labels
        }
        on_body = [i for i in kept if i not in taken | inside]
        body_how = "all others that have a name" if unlabelled else "all others"
    named_ones = taken | set(on_body)
    if not on_body:
        if len(unlabelled) == len(table.labels) and unlabelled:
            raise refused(
                where,
                f"all {len(unlabelled)} markers are unlabelled ({named([table.labels[i] for i in unlabelled])}): "
                "say which are on the body (--body 'Unlabeled*')",
            )
        raise refused(
            where, f"no marker is left on the body; {len(taken)} of {len(table.labels)} are the gripper's"
        )
    return Belonging(
        tuple(held),
        bodies,
        tuple(on_body),
        tuple(i for i in range(len(table.labels)) if i not in named_ones),
        how,
        body_how,
    )


def _short(label: str) -> str:
    return label.rpartition(":")[2].strip().strip('"')


def _chosen(
    table: MarkerTable, where: str, names: tuple[str, ...], what: str
) -> tuple[list[int], tuple[RigidBody, ...]]:
    """Markers that the names name, in their order, and rigid bodies without markers of their own."""
    found: list[int] = []
    bodies: list[RigidBody] = []
    for name in names:
        members = [i for i, label in enumerate(table.labels) if label == name]
        own = next((one for one in table.bodies if one.name == name), None)
        if own is not None and what == "gripper" and len(table.sets.get(name, ())) < LEAST_GROUP:
            bodies.append(own)
            continue
        if not members and name in table.sets:
            members = [table.labels.index(label) for label in table.sets[name]]
        if not members:
            members = [i for i, label in enumerate(table.labels) if _short(label) == name]
        if not members and any(mark in name for mark in "*?"):
            members = [
                i
                for i, label in enumerate(table.labels)
                if fnmatch.fnmatchcase(label, name) or fnmatch.fnmatchcase(_short(label), name)
            ]
        if not members:
            raise refused(where, f"has no marker {shortened(name)} for the {what}; {_there(table)}")
        found += [i for i in members if i not in found]
    return found, tuple(bodies)


def _there(table: MarkerTable) -> str:
    groups = [*table.sets, *(one.name for one in table.bodies if one.name not in table.sets)]
    return f"its markers are {named(table.labels)}" + (f", its groups {named(groups)}" if groups else "")


def _guessed(
    table: MarkerTable, where: str, kept: list[int], said_body: list[int] | None
) -> tuple[list[int], tuple[RigidBody, ...], str]:
    """Markers and rigid bodies that hold the object, and how that was found."""
    free = [i for i in kept if said_body is None or i not in said_body]
    if table.bodies:
        called = [
            one for one in table.bodies if GRIPPER_NAME.match(_short(one.name.strip("/").rpartition("/")[2]))
        ]
        bodies = called or list(table.bodies)
        markers = [
            table.labels.index(label)
            for one in bodies
            if len(table.sets.get(one.name, ())) >= LEAST_GROUP
            for label in table.sets[one.name]
        ]
        poses = tuple(one for one in bodies if len(table.sets.get(one.name, ())) < LEAST_GROUP)
        own = {table.labels.index(one.name) for one in poses if one.name in table.labels}
        left = [i for i in free if i not in own and i not in markers]
        if said_body is not None or left:
            return markers, poses, f"rigid body of the file: {named([one.name for one in bodies])}"
    called_groups = [g for g in table.sets if GRIPPER_NAME.match(g)]
    by_name = [
        i
        for i in free
        if GRIPPER_NAME.match(_short(table.labels[i]))
        or any(table.labels[i] in table.sets[g] for g in called_groups)
    ]
    if by_name:
        return by_name, (), "by their names"
    groups = rigid_groups(table.places[:, free], table.seen[:, free])
    members = [[free[i] for i in group] for group in groups]
    how = f"{len(members[0]) if members else 0} markers that keep their distances while others do not"
    if len(members) == 1 and (len(members[0]) < len(free) or said_body is not None):
        return members[0], (), how
    if members and sum(map(len, members)) == len(free) and len(members) > 1:
        still = [group for group in members if _is_still(table, group)]
        if len(still) == 1:
            return still[0], (), f"{len(still[0])} markers that stay where they are"
    told = "; ".join(named([table.labels[i] for i in group]) for group in members[:4])
    seen = (
        f"{len(members)} groups keep their distances ({told})"
        if len(members) > 1
        else "nothing in the data tells it"
    )
    raise refused(
        where,
        f"names no controller: say which markers hold the body (--gripper NAMES, or none): {seen}; {_there(table)}",
    )


def _is_still(table: MarkerTable, group: list[int]) -> bool:
    """Whether markers stay where they are, within their noise and a thousandth of the recording's extent."""
    seen, places = table.seen[:, group], table.places[:, group]
    middle = np.nanmedian(np.where(seen[..., None], places, np.nan), axis=0)
    away = np.linalg.norm(places - middle, axis=2)[seen]
    extent = float(np.linalg.norm(np.ptp(table.places[table.seen], axis=0)))
    sigma = float(np.median(third_difference_noise(places, seen)))
    return float(np.quantile(away, 0.95)) <= max(RIGID_SIGMAS * sigma, RIGID_SHARE * extent)


def rigid_groups(places: Array, seen: Array) -> list[list[int]]:
    """Groups of three or more markers whose mutual distances stay constant while those of others change, largest first.

    Args:
        places: (T, N, 3) in any unit.
        seen: (T, N) bool.
    """
    count = places.shape[1]
    if count < LEAST_GROUP or count > MOST_COMPARED or len(places) < 8:
        return []
    frames = np.unique(np.linspace(0, len(places) - 1, min(len(places), SAMPLED_FRAMES)).astype(int))
    sigma = third_difference_noise(places, seen)
    sampled, known = places[frames], seen[frames]
    spread, distance = np.full((count, count), np.inf), np.zeros((count, count))
    for i in range(count - 1):
        apart = np.linalg.norm(sampled[:, i + 1 :] - sampled[:, i, None], axis=2)
        both = known[:, i + 1 :] & known[:, i, None]
        enough = both.sum(axis=0) >= max(8, len(frames) // 10)
        values = np.where(both[:, enough], apart[:, enough], np.nan)
        if values.shape[1]:
            low, middle, high = np.nanquantile(values, [0.05, 0.5, 0.95], axis=0)
            others = np.flatnonzero(enough) + i + 1
            spread[i, others] = spread[others, i] = high - low
            distance[i, others] = distance[others, i] = middle
    finite = spread[np.triu_indices(count, 1)]
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return []
    noise = np.sqrt(sigma[:, None] ** 2 + sigma[None] ** 2)
    allowed = np.maximum(RIGID_SIGMAS * noise, RIGID_SHARE * distance)
    usual = float(np.quantile(finite, 0.9))
    rigid = (spread <= allowed) & (DEFORMING_FACTOR * spread <= usual)
    return [group for group in _cliques(rigid) if _off_a_line(places[:, group], seen[:, group])]


def _off_a_line(places: Array, seen: Array) -> bool:
    """Whether markers do not lie on a line, in the frame that shows most: a stretched row keeps its distances, too."""
    frame = int(np.argmax(seen.sum(axis=1)))
    there = places[frame, seen[frame]]
    extents = np.linalg.svd(there - there.mean(axis=0), compute_uv=False)
    return bool(len(there) >= LEAST_GROUP and extents[1] > LINE_SHARE * extents[0])


def _cliques(rigid: Array) -> list[list[int]]:
    """Groups in which every pair is rigid, the largest first, each marker in one."""
    left = set(range(len(rigid)))
    groups = []
    while left:
        best: list[int] = []
        for seed in sorted(left, key=lambda i: -int(rigid[i].sum())):
            if int(rigid[seed].sum()) + 1 <= len(best):
                break
            group = [seed]
            for other in sorted(left - {seed}, key=lambda i: -int(rigid[i].sum())):
                if rigid[other, group].all():
                    group.append(other)
            if len(group) > len(best):
                best = group
        if len(best) < LEAST_GROUP:
            break
        groups.append(sorted(best))
        left -= set(best)
    return groups


def third_difference_noise(places: Array, seen: Array) -> Array:
    """White noise of each marker per axis (N,), from third differences: an upper estimate; 0 where there are none."""
    if len(places) < 4:
        return np.zeros(places.shape[1])
    four = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:]
    third = np.empty(four.shape)
    for t in range(len(third)):
        third[t] = np.abs(np.diff(places[t : t + 4], n=3, axis=0)[0]).max(axis=1)
    found = np.zeros(places.shape[1])
    for i in range(places.shape[1]):
        if four[:, i].any():
            found[i] = float(np.median(third[four[:, i], i])) / GAUSSIAN_MAD / THIRD_DIFFERENCE_GAIN**0.5
    return found
