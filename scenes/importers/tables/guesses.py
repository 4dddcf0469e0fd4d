"""What the numbers tell where the file does not: unit, the axis that points up, the frame rate, the noise.

Each guess says how it was made, for a person to confirm or to say otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.axes import ROTATION_FROM_UP, axis_along
from physworld_scenes.importers.options import estimate_noise
from physworld_scenes.importers.tables.table import METRES_PER_UNIT, MarkerTable, refused, unit_of

USUAL_EXTENT_M, EXTENT_FACTOR = 0.7, 3.5
USUAL_ACCELERATION_M_S2, ACCELERATION_FACTOR = 5.0, 4.0
"""Of what markers span, and of their faster accelerations: the usual value, the factor of one standard deviation."""
USUAL_UNITS = {"m": 0.45, "mm": 0.45, "cm": 0.1}
SURE = 0.9
ACCELERATION_STEP_S = 0.04
HANGING = (None, "rope", "branched_rope", "sheet")
HANGS = 0.85
"""Cosine of the angle to an axis, above which what hangs points along it."""
REST_FRAMES = 25
QUIET = 1.5
"""Of the estimate from third differences, up to which the quietest frames count as at rest."""
RATES_AGREE = 0.02
GRID_SHARE = 0.02
"""Of a frame, by which times may be off the frames of the rate and still be rounded ones."""


@dataclass(frozen=True)
class Guess:
    """A line for a person: what, the value, how it was found, and the field of the options that says otherwise."""

    what: str
    value: str
    how: str
    option: str


def unit(
    table: MarkerTable, where: str, given: str | None, extent: float, acceleration: float
) -> tuple[str, str, str | None]:
    """The unit, how it was found, and a warning if the data leave it open.

    Args:
        table: the file's tracks.
        where: its name, in errors.
        given: the unit that a person says.
        extent: of all markers, in the file's numbers.
        acceleration: likewise the faster ones of them (numbers/s²), 0 if nothing moves.

    Raises:
        SceneInvalid: no such unit.
    """
    if given is not None:
        said = f"; {table.unit_from} {table.unit}" if table.unit not in (None, unit_of(given, where)) else ""
        return unit_of(given, where), f"given{said}", None
    if table.unit is not None:
        return table.unit, table.unit_from, None
    likely = {}
    for name, share in USUAL_UNITS.items():
        off = [_deviations(extent * METRES_PER_UNIT[name], USUAL_EXTENT_M, EXTENT_FACTOR)]
        off.append(
            _deviations(acceleration * METRES_PER_UNIT[name], USUAL_ACCELERATION_M_S2, ACCELERATION_FACTOR)
        )
        likely[name] = share * float(np.exp(-0.5 * np.sum(np.square(off))))
    best = max(likely, key=lambda name: likely[name])
    share = likely[best] / max(sum(likely.values()), 1e-300)
    scale = METRES_PER_UNIT[best]
    how = f"guessed: the markers span {extent * scale:.3g} m then, with {acceleration * scale:.2g} m/s²"
    return best, how, None if share > SURE else f"the unit may be another one than {best}: --unit says it"


def _deviations(value: float, usual: float, factor: float) -> float:
    return float(np.log(value / usual) / np.log(factor)) if value > 0.0 else 0.0


def faster_acceleration(places: Array, seen: Array, step_s: float) -> float:
    """The 95th percentile of accelerations, by second differences over some frames.

    Args:
        places: (T, N, 3) in any unit.
        seen: (T, N) bool.
        step_s: of a frame [s].
    """
    stride = max(1, min(round(ACCELERATION_STEP_S / step_s), (len(places) - 1) // 2))
    if len(places) < 2 * stride + 1:
        return 0.0
    found = []
    for t in range(len(places) - 2 * stride):
        before, now, after = (places[t + step * stride] for step in range(3))
        known = seen[t] & seen[t + stride] & seen[t + 2 * stride]
        found.append(np.linalg.norm(after - 2.0 * now + before, axis=1)[known])
    sizes = np.concatenate(found)
    return float(np.quantile(sizes, 0.95)) / (stride * step_s) ** 2 if sizes.size else 0.0


def up(
    table: MarkerTable, where: str, given: str | None, kind: str | None, low: Array, gripper: Array | None
) -> tuple[str, str, str | None]:
    """The axis that points up, how it was found, and a warning if the data speak against it.

    Args:
        table: the file's tracks.
        where: its name, in errors.
        given: the axis that a person says.
        kind: of the object; a beam stands out from its clamp where a rope or a cloth hangs.
        low: the least of each coordinate of the body's seen places, (3,), in the file's axes.
        gripper: from the body's middle to the gripper's, the mean of all frames, (3,); None: no gripper.

    Raises:
        SceneInvalid: no such axis.
    """
    for axis in (given, table.up):
        if axis is not None and axis not in ROTATION_FROM_UP:
            raise refused(where, f"up is {axis!r}; known are {', '.join(ROTATION_FROM_UP)}")
    hangs = None
    if gripper is not None and kind in HANGING and np.linalg.norm(gripper) > 0.0:
        direction = gripper / np.linalg.norm(gripper)
        if float(np.abs(direction).max()) > HANGS:
            hangs = axis_along(direction)
    if given is not None:
        return given, "given", None
    if table.up is not None:
        against = None
        if hangs is not None and hangs[-1] != table.up[-1]:
            against = f"up is {table.up}, {table.up_from}; the body hangs from its gripper along {hangs}: --up {hangs}?"
        return table.up, table.up_from, against
    if hangs is not None:
        return (
            hangs,
            "guessed: the body hangs from its gripper along it",
            f"up is guessed to be {hangs}: --up says it",
        )
    if low[1] >= 0.0 > low[2]:
        return (
            "y",
            "guessed: no marker is below 0 along y, some are along z",
            "up is guessed to be y: --up says it",
        )
    return "z", "assumed: nothing in the data tells it", "up is assumed to be z: --up says it"


def clock(table: MarkerTable, where: str, given: float | None) -> tuple[Array, float, str]:
    """Times from the first frame (T,) [s], frames per second, and how they were found. Raises SceneInvalid."""
    count = len(table.places)
    if given is not None:
        measured = table.rate_hz or (
            None if table.times is None else 1.0 / float(np.median(np.diff(table.times)))
        )
        said = (
            f"; the file has {measured:.6g} Hz"
            if measured is not None and abs(measured - given) > 1e-6 * given
            else ""
        )
        steps = np.arange(count) if table.frames is None else table.frames - table.frames[0]
        if table.times is not None and measured is not None:
            steps = np.round((table.times - table.times[0]) * measured)
            steps = steps if (np.diff(steps) > 0).all() else np.arange(count)
        return steps / given, given, f"given{said}"
    if table.times is None:
        if table.rate_hz is None:
            raise refused(
                where, f"has {count} frames, and neither times nor a frame rate: say it (--rate HZ)"
            )
        steps = np.arange(count) if table.frames is None else table.frames - table.frames[0]
        return steps / table.rate_hz, table.rate_hz, "the file says so"
    times = table.times - table.times[0]
    rate = 1.0 / float(np.median(np.diff(times)))
    if table.rate_hz is not None and abs(rate / table.rate_hz - 1.0) <= RATES_AGREE:
        steps = np.round(times * table.rate_hz)
        if (
            np.abs(times * table.rate_hz - steps).max() <= max(GRID_SHARE, 1e-5 * table.rate_hz)
            and (np.diff(steps) > 0).all()
        ):
            return steps / table.rate_hz, table.rate_hz, "the file says so, and its times agree"
    if table.rate_hz is not None and abs(rate / table.rate_hz - 1.0) > RATES_AGREE:
        return times, rate, f"its times; its header says {table.rate_hz:.6g} Hz"
    return times, rate, "its times"


def noise(points: Array, visible: Array) -> tuple[float | None, str]:
    """White noise per axis [m] and how it was found: from frames at rest, else from third differences.

    Args:
        points: (T, N, 3) [m].
        visible: (T, N) bool.
    """
    upper = estimate_noise(points, visible)
    if upper is None:
        return None, "unknown: no marker is seen in four frames running, or nothing varies"
    best, at = np.inf, 0
    for begin in range(0, len(points) - REST_FRAMES + 1, max(1, REST_FRAMES // 2)):
        window, seen = points[begin : begin + REST_FRAMES], visible[begin : begin + REST_FRAMES].all(axis=0)
        if 2 * int(seen.sum()) < visible.shape[1]:
            continue
        sigma = float(np.sqrt(np.mean(window[:, seen].var(axis=0, ddof=1))))
        if sigma < best:
            best, at = sigma, begin
    if 0.0 < best <= QUIET * upper:
        return best, f"{REST_FRAMES} frames at rest, {at} to {at + REST_FRAMES - 1}"
    return upper, "upper estimate from third differences"
