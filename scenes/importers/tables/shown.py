"""The markers of a table as a preview draws them: where each is, and what it would be taken for."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.belonging import LEAST_GROUP, Belonging
from physworld_scenes.importers.tables.table import MarkerTable

MOST_SHOWN = 2000
"""Markers; of more there is no drawing that a person chooses in."""

Shown = tuple[str, tuple[str, ...], bool, tuple[float, float, float]]
"""Name, roles, whether it is a rigid body's pose, place [m]."""


def shown(table: MarkerTable, who: Belonging, turn: Array) -> tuple[Shown, ...]:
    """Every marker in the frame that shows most of them, else where it is seen first; none of more than MOST_SHOWN.

    They are in the file's order, those on the body in the order that the points have.

    Args:
        table: the file's tracks, each marker seen somewhere.
        who: what belongs to what.
        turn: (3, 3), the file's unit and axes to metres in the scene's world.
    """
    if len(table.labels) + len(table.bodies) > MOST_SHOWN:
        return ()
    frame = int(np.argmax(table.seen.sum(axis=1)))
    on_body, gripper = set(who.body), set(who.gripper)
    body_order = iter(who.body)
    found: list[Shown] = []
    for i in (next(body_order) if i in on_body else i for i in range(len(table.labels))):
        roles = (*(("body",) if i in on_body else ()), *(("gripper",) if i in gripper else ()))
        place = _place(table.places[:, i], table.seen[:, i], frame, turn)
        found.append((table.labels[i], roles, False, place))
    held = {body.name for body in who.bodies}
    taken = {name for name, roles, _, _ in found if roles}
    poses = [
        (
            body.name,
            ("gripper",) if body.name in held else (),
            True,
            _place(body.places, body.seen, frame, turn),
        )
        for body in table.bodies
        if len(table.sets.get(body.name, ())) < LEAST_GROUP and body.name not in taken and body.seen.any()
    ]
    replaced = {pose[0] for pose in poses}
    return (*(one for one in found if one[0] not in replaced), *poses)


def _place(places: Array, seen: Array, frame: int, turn: Array) -> tuple[float, float, float]:
    """Of a track (T, 3) that is seen somewhere (T,)."""
    x, y, z = (turn @ places[frame if seen[frame] else int(np.argmax(seen))]).tolist()
    return x, y, z
