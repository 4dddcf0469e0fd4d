"""From the tracks in a file to a scene: who is what, metres, z up, seconds, what is seen; and what was guessed on
the way.

``reading_of`` finds all of it and needs nothing that only a person knows; ``scene_of`` asks for the facts of the body
and makes the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.options import ImportOptions, split_of
from physworld_scenes.importers.tables import guesses
from physworld_scenes.importers.tables.belonging import Belonging, belonging, third_difference_noise
from physworld_scenes.importers.tables.facts import asked_facts, chain_facts
from physworld_scenes.importers.tables.guesses import Guess
from physworld_scenes.importers.tables.shown import shown
from physworld_scenes.importers.tables.swaps import lost, swapped
from physworld_scenes.importers.tables.table import (
    METRES_PER_UNIT,
    MarkerTable,
    RigidBody,
    named,
    refused,
    shortened,
)

ARM_M = 0.05
"""Length of the arms along a rigid body's axes, whose ends are controllers: its pose as four points."""
GAP_WARNING = 0.1
MOST_NAMED_IN_NOTES = 2000

TableReader = Callable[[bytes, str], MarkerTable]


@dataclass(frozen=True)
class Reading:
    """A recording of markers in the scene's world.

    Attributes:
        form: of the file, for people.
        points: (T, N, 3) [m], z up; visible: (T, N).
        controllers: (T, K, 3) [m].
        times: (T,) [s] from the first frame.
        fps: frames per second.
        noise_sigma_m: per axis, or None.
        labels, controller_labels: of points and controllers.
        guesses: what was found, a line each.
        lines: what was left out, for people.
        warnings: what speaks against a guess.
        interpolated: samples of controllers that were not seen.
        unit, up: of the file.
        markers: all of the file as a preview draws them (``Looked``).
    """

    form: str
    points: Array
    visible: Array
    controllers: Array
    times: Array
    fps: float
    noise_sigma_m: float | None
    labels: tuple[str, ...]
    controller_labels: tuple[str, ...]
    guesses: tuple[Guess, ...]
    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    interpolated: int
    unit: str
    up: str
    markers: tuple[tuple[str, tuple[str, ...], bool, tuple[float, float, float]], ...]


def reading_of(table: MarkerTable, where: str, options: ImportOptions) -> Reading:
    """The recording in a table, with everything guessed that is not said.

    Args:
        table: the file's tracks.
        where: the file's name, in errors.
        options: what a person says.

    Raises:
        SceneInvalid: something is missing that nothing tells; with the numbers.
    """
    if len(table.places) < 2:
        raise refused(where, f"has {len(table.places)} frames; a motion needs 2 or more")
    if not table.labels:
        raise refused(where, f"has {len(table.bodies)} rigid bodies and no marker: nothing is on the object")
    lines, warnings = list(table.lines), []
    never = [i for i in range(len(table.labels)) if not table.seen[:, i].any()]
    if never:
        lines.append(
            f"{len(never)} markers are never seen and dropped: {named([table.labels[i] for i in never])}"
        )
        absent = [
            table.labels[i]
            for i in never
            if table.labels[i] in {*(options.controllers or ()), *(options.markers or ())}
        ]
        if absent:
            raise refused(where, f"markers that are named and never seen: {named(absent)}")
        table = _without(table, set(never))
        if not table.labels:
            raise refused(where, f"none of its {len(never)} markers is ever seen")
    who = belonging(table, where, options.controllers, options.markers)
    if who.dropped:
        lines.append(
            f"{len(who.dropped)} markers are dropped: {named([table.labels[i] for i in who.dropped])}"
        )
    seen, who = _unswapped(table, where, who, lines)
    guessed: list[Guess] = []
    body, body_seen = _chosen(table.places, who.body), _chosen(seen, who.body)
    if not body_seen.any():
        raise refused(where, f"none of the {len(who.body)} markers on the body is ever seen")
    times, fps, rate_how = guesses.clock(table, where, options.fps)
    fast = guesses.faster_acceleration(body, body_seen, 1.0 / fps)
    low, high = _corners(table.places, seen)
    extent = float(np.linalg.norm(high - low))
    unit, unit_how, unsure = guesses.unit(table, where, options.unit, extent, fast)
    scale = METRES_PER_UNIT[unit]
    held, held_seen, held_labels = _controllers(table, seen, who, scale)
    axis, up_how, against = guesses.up(
        table,
        where,
        options.up,
        options.kind,
        _corners(body, body_seen)[0],
        _towards(body, body_seen, held, held_seen),
    )
    warnings += [said for said in (unsure, against) if said]
    turn = scale * ROTATION_FROM_UP[axis]
    first = int(np.argmax(body_seen.any(axis=1)))
    if first:
        lines.append(f"the first {first} frames are left out: no marker on the body is seen in them")
    if len(times) - first < 2:
        raise refused(
            where, f"markers on the body are seen in {len(times) - first} frames; a motion needs 2 or more"
        )
    visible = body_seen[first:]
    points = fill_gaps(body[first:], visible)
    for frame in points:
        frame[...] = frame @ turn.T
    controllers = fill_gaps(held[first:], held_seen[first:]) @ turn.T
    interpolated = int((~held_seen[first:]).sum())
    if held_seen.size and interpolated / held_seen[first:].size > GAP_WARNING:
        share = interpolated / held_seen[first:].size
        warnings.append(f"controllers: {share:.0%} of the samples are gaps, filled in by interpolation")
    sigma, noise_how = (
        (options.noise_sigma_m, "given") if options.noise_sigma_m else guesses.noise(points, visible)
    )
    labels = tuple(table.labels[i] for i in who.body)
    guessed += [
        Guess("up", axis, up_how, "up"),
        Guess("unit", unit, unit_how, "unit"),
        Guess("rate", f"{fps:.6g} Hz", rate_how, "fps"),
        Guess("gripper", named(_held_names(table, who)) or "none", who.gripper_how, "controllers"),
        Guess("body", f"{len(labels)} markers: {named(labels)}", who.body_how, "markers"),
        Guess("noise", "unknown" if sigma is None else f"{1e3 * sigma:.3g} mm", noise_how, "noise_sigma_m"),
    ]
    times = times[first:] - times[first]
    return Reading(
        table.form, points, visible, controllers, times, fps, sigma, labels, held_labels, tuple(guessed), tuple(lines),
        tuple(warnings), interpolated, unit, axis, shown(table, who, turn),
    )  # fmt: skip


def scene_of(reading: Reading, where: str, name: str, options: ImportOptions) -> tuple[Scene, list[str]]:
    """The scene of a recording, and its warnings.

    Args:
        reading: tracks, controllers and guesses.
        where: the file's form, for messages.
        name: of the scene where the options have none.
        options: what was said of the body.

    Raises:
        SceneInvalid: facts of the body are missing, or the validator's faults.
    """
    kind, facts, assumed = asked_facts(where, reading.points, options)
    facts, order = chain_facts(kind, facts, reading.points, reading.visible)
    guessed = [*reading.guesses, *([order] if order else [])]
    declared = {
        "schema_version": 1,
        "name": options.name or name,
        "kind": kind,
        "description": f"markers imported from {reading.form}",
        "fps": float(reading.fps),
        "gravity_m_s2": list(options.gravity_m_s2),
        "noise_sigma_m": reading.noise_sigma_m,
        "split": split_of(len(reading.points)),
        "initial_state": "as measured",
        "body": facts,
        "ground": None,
        "grips": None,
        "notes": {
            "source": {"format": reading.form, "unit": reading.unit, "up": reading.up},
            "guessed": [asdict(guess) for guess in guessed],
            "left_out": [shortened(line, 400) for line in reading.lines],
            "point_labels": list(reading.labels[:MOST_NAMED_IN_NOTES]),
            "controller_labels": list(reading.controller_labels[:MOST_NAMED_IN_NOTES]),
            "noise": next(guess.how for guess in guessed if guess.what == "noise"),
            "controller_samples_interpolated": reading.interpolated,
        },
    }
    arrays = {
        "points": reading.points,
        "visible": reading.visible,
        "controllers": reading.controllers,
        "times": reading.times,
    }
    scene, warnings = checked(scene_from_parts(declared, arrays))
    return scene, [*reading.warnings, *assumed, *warnings]


def _chosen(values: Array, markers: tuple[int, ...]) -> Array:
    """Of (T, N, ...) those of some markers; all of them in their order are not copied."""
    return values if markers == tuple(range(values.shape[1])) else values[:, list(markers)]


def _corners(places: Array, seen: Array) -> tuple[Array, Array]:
    """The least and the greatest of each coordinate (3,) of places (T, N, 3) where they are seen (T, N)."""
    shown = [(frame[known].min(axis=0), frame[known].max(axis=0)) for frame, known in zip(places, seen, strict=True)
             if known.any()]  # fmt: skip
    low, high = zip(*shown, strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def fill_gaps(positions: Array, valid: Array) -> Array:
    """Positions (T, N, 3) with every gap interpolated in time, held at the ends; zero if never seen."""
    filled = np.zeros_like(positions)
    frames = np.arange(len(positions))
    for i in range(positions.shape[1]):
        known = valid[:, i]
        if known.any():
            for axis in range(3):
                filled[:, i, axis] = np.interp(frames, frames[known], positions[known, i, axis])
    return filled


def _without(table: MarkerTable, dropped: set[int]) -> MarkerTable:
    """The table without some markers."""
    kept = [i for i in range(len(table.labels)) if i not in dropped]
    gone = {table.labels[i] for i in dropped}
    sets = {name: tuple(m for m in members if m not in gone) for name, members in table.sets.items()}
    return replace(
        table,
        labels=tuple(table.labels[i] for i in kept),
        places=table.places[:, kept],
        seen=table.seen[:, kept],
        sets={name: members for name, members in sets.items() if members},
    )


def _unswapped(table: MarkerTable, where: str, who: Belonging, lines: list[str]) -> tuple[Array, Belonging]:
    """What is seen (T, N) without samples whose label was on another marker; markers that mostly were are dropped."""
    used = sorted({*who.gripper, *who.body})
    seen = table.seen.copy()
    places = _chosen(table.places, tuple(used))
    sigma = third_difference_noise(places, seen[:, used])
    wrong = swapped(places, seen[:, used], sigma) & seen[:, used]
    if not wrong.any():
        return seen, who
    gone = {used[i] for i in np.flatnonzero(lost(wrong, seen[:, used]))}
    for index, marker in enumerate(used):
        if wrong[:, index].any() and marker not in gone:
            frames = np.flatnonzero(wrong[:, index])
            lines.append(
                f"{len(frames)} samples of {table.labels[marker]} are dropped, frames {frames[0]} to {frames[-1]}: "
                "its label is on another marker"
            )
    seen[:, used] &= ~wrong
    if gone:
        lines.append(
            f"{len(gone)} markers are dropped, whose labels are on others most of the time: "
            f"{named([table.labels[i] for i in sorted(gone)])}"
        )
    body = tuple(i for i in who.body if i not in gone)
    if not body:
        raise refused(where, f"all {len(who.body)} markers on the body change places with others")
    return seen, replace(who, gripper=tuple(i for i in who.gripper if i not in gone), body=body)


def _controllers(
    table: MarkerTable, seen: Array, who: Belonging, scale: float
) -> tuple[Array, Array, tuple[str, ...]]:
    """Places of the controllers in the file's unit (T, K, 3), whether they are seen (T, K), and their names."""
    places = [table.places[:, list(who.gripper)]]
    known = [seen[:, list(who.gripper)]]
    labels = [table.labels[i] for i in who.gripper]
    for body in who.bodies:
        arms = (
            np.zeros((1, 3))
            if body.quaternions_wxyz is None
            else np.vstack([np.zeros(3), np.eye(3)]) * ARM_M / scale
        )
        places.append(_carried(body, arms))
        known.append(np.repeat(body.seen[:, None], len(arms), axis=1))
        labels += [f"{body.name} {part}" for part in ("origin", "x", "y", "z")[: len(arms)]]
    return np.concatenate(places, axis=1), np.concatenate(known, axis=1), tuple(labels)


def _carried(body: RigidBody, arms: Array) -> Array:
    """Points (K, 3) in a rigid body's frame at every frame, (T, K, 3)."""
    if body.quaternions_wxyz is None:
        return body.places[:, None] + arms
    w, v = body.quaternions_wxyz[:, None, :1], body.quaternions_wxyz[:, None, 1:]
    twice = 2.0 * np.cross(v, np.broadcast_to(arms, (len(v), *arms.shape)))
    return body.places[:, None] + arms + w * twice + np.cross(np.broadcast_to(v, twice.shape), twice)


def _towards(body: Array, body_seen: Array, held: Array, held_seen: Array) -> Array | None:
    """From the body's middle to the gripper's, the mean of the frames in which both are seen, (3,).

    Args:
        body, held: places (T, N, 3) and (T, K, 3).
        body_seen, held_seen: where they are seen, (T, N) and (T, K).
    """
    both = body_seen.any(axis=1) & held_seen.any(axis=1)
    if not both.any():
        return None
    middles = [
        np.where(known[both][..., None], places[both], 0.0).sum(axis=1) / known[both].sum(axis=1)[:, None]
        for places, known in ((held, held_seen), (body, body_seen))
    ]
    return np.asarray((middles[0] - middles[1]).mean(axis=0))


def _held_names(table: MarkerTable, who: Belonging) -> list[str]:
    return [*(f"{body.name} (its pose)" for body in who.bodies), *(table.labels[i] for i in who.gripper)]
