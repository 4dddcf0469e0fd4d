"""Checks of what was measured: shapes, times, places, visibility, units, controllers.

Every check adds its findings and lets the next one run, so that one reading names every fault. A *fault* says
that no result could be trusted; a *warning* says that a person should look. Thresholds stand at the top with
their reasons. Legend: T frames, N tracked points, K controllers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld_schemas.arrays import FARTHEST_M
from physworld_schemas.base import FieldError

LARGEST_OBJECT_M = 20.0
SMALLEST_OBJECT_M = 1e-3
PLAUSIBLE_OBJECT_M = (0.01, 5.0)
"""Objects that a camera rig or a motion-capture volume holds; a unit is suggested if it leads in here."""

UNIT_FACTORS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "kilometres": 1e3}

FAR_CONTROLLER_FAULT = 3.0
FAR_CONTROLLER_WARNING = 1.5
"""Closest approach of a controller to a tracked point, in object sizes. Markers on the clamp of a beam that
is tracked at its tip only lie 1.1 sizes away."""

CONTROL_CHECK_FRAMES = 40
FPS_FAULT = 1.5
FPS_WARNING = 1.1
"""Factor between the declared frame rate and one over the median time step."""

BLOCK_VALUES = 1 << 20
"""So many numbers are looked at together, not a whole recording."""

UNEVEN_STEP = 3.0
NAMED_AT_MOST = 5

ARRAY_SHAPES = {
    "points": ("T", "N", 3),
    "visible": ("T", "N"),
    "controllers": ("T", "K", 3),
    "times": ("T",),
    "controller_velocities": ("T", "K", 3),
    "controller_errors": ("E", "T", "K", 3),
    "ctrl_times": ("C",),
    "ctrl_points": ("C", "K", 3),
    "rest_volume_points": ("M", 3),
    "surface_points": ("S", 3),
    "noise_covariance": ("N", 3, 3),
}
REQUIRED = ("points", "visible", "controllers", "times")
NEVER_EMPTY = ("rest_volume_points", "ctrl_times", "ctrl_points")
PLACES = ("points", "controllers", "controller_errors", "ctrl_points", "rest_volume_points", "surface_points")


@dataclass
class Findings:
    """What the checks found."""

    faults: list[FieldError] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def fault(self, loc: Iterable[str | int], message: str) -> None:
        """Add a fault at ``loc``."""
        self.faults.append(FieldError(loc=list(loc), msg=message))

    def warn(self, loc: Iterable[str | int], message: str) -> None:
        """Add a warning at ``loc``."""
        self.warnings.append(f"{'.'.join(str(part) for part in loc)}: {message}")


@dataclass(frozen=True)
class Measured:
    """The arrays whose shapes agree, as float64 and bool.

    Attributes:
        points: (T, N, 3) [m], zero where not visible.
        seen: (T, N) bool, visible and finite.
        controllers: (T, K, 3) [m]; where one is not finite its value before it stands.
        times: (T,) [s].
        size_m: diagonal of the box around the points that are visible in the first frame that shows any,
            0 when none does.
    """

    points: Array
    seen: Array
    controllers: Array
    times: Array
    size_m: float

    @property
    def first_frame(self) -> int:
        """The first frame with a visible point."""
        return int(np.argmax(self.seen.any(axis=1)))


def check_arrays(arrays: dict[str, Array], findings: Findings) -> Measured | None:
    """Shapes, types and values; the arrays to go on with, or None when they cannot be read together."""
    for name in REQUIRED:
        if name not in arrays:
            findings.fault(
                ["scene.npz", name], f"is missing; there are {', '.join(sorted(arrays)) or 'none'}"
            )
    if ("ctrl_times" in arrays) != ("ctrl_points" in arrays):
        findings.fault(["scene.npz", "ctrl_times"], "ctrl_times and ctrl_points come together or not at all")
    lengths: dict[str, tuple[int, str]] = {}
    sound = {
        name
        for name, wanted in ARRAY_SHAPES.items()
        if name in arrays and _check_shape(name, arrays[name], wanted, lengths, findings)
    }
    _check_others(arrays, findings)
    if not sound.issuperset(REQUIRED):
        return None
    frames, count = arrays["points"].shape[:2]
    if frames < 2:
        findings.fault(["scene.npz", "points"], f"has {frames} frames; a motion needs 2 or more")
    if count < 1:
        findings.fault(["scene.npz", "points"], "has no point")
    if not arrays["controllers"].shape[1]:
        findings.warn(["scene.npz", "controllers"], "there is none: nothing drives the object")
    if frames < 2 or count < 1:
        return None
    for name in ARRAY_SHAPES:
        if name in sound and name not in ("points", "visible"):
            _check_finite(name, arrays[name], findings)
    return _measure(arrays, findings)


def check_times(times: Array, fps: float | None, findings: Findings) -> None:
    """Strictly increasing seconds from the first frame, at the declared rate."""
    where = ["scene.npz", "times"]
    if not np.isfinite(times).all():
        return
    step = np.diff(times)
    for what, bad in (("repeats", step == 0.0), ("goes back", step < 0.0)):
        if bad.any():
            t = int(np.argmax(bad)) + 1
            findings.fault(
                where,
                f"{what} in {int(bad.sum())} of {len(step)} steps, first at frame {t}:"
                f" {times[t]:.6g} s after {times[t - 1]:.6g} s",
            )
    if (step <= 0.0).any():
        return
    if abs(times[0]) > step.min() / 2:
        findings.fault(where, f"begins at {times[0]:.6g} s; it counts from the first frame, so subtract that")
    median = float(np.median(step))
    if step.max() > UNEVEN_STEP * median:
        t = int(np.argmax(step)) + 1
        findings.warn(
            where, f"frame {t} comes {step.max():.4g} s after the one before, the median is {median:.4g} s"
        )
    if fps is None:
        return
    factor = max(fps * median, 1.0 / (fps * median))
    if factor > FPS_WARNING:
        unit = " (times look like milliseconds: divide by 1000)" if 500 < fps * median < 2000 else ""
        message = (
            f"the median step {median:.6g} s means {1 / median:.4g} frames/s, declared are {fps:.4g}{unit}"
        )
        (findings.fault if factor > FPS_FAULT else findings.warn)(where, message)


def check_places(arrays: dict[str, Array], measured: Measured, findings: Findings) -> bool:
    """Whether all places are within ``FARTHEST_M`` of the origin along each axis; the others are named.

    What is computed with a place of 1e300 m overflows, and at 1 km single precision no longer resolves a
    tracking error.
    """
    near = True
    cleaned = {"points": measured.points, "controllers": measured.controllers}
    for name in PLACES:
        given = cleaned.get(name, arrays.get(name))
        if given is None or not given.size or given.dtype.kind not in "fiu":
            continue
        count, farthest, first = _farthest(given)
        if count:
            findings.fault(
                ["scene.npz", name],
                f"{count} of {given.size} values are farther than {FARTHEST_M:g} m from the origin,"
                f" the farthest {farthest:.4g} m at {first}: not metres?{unit_hint(measured.size_m)}",
            )
            near = False
    return near


def _farthest(places: Array) -> tuple[int, float, tuple[int, ...]]:
    """How many values lie beyond ``FARTHEST_M``, the farthest of all [m], and its indices; some rows at a time."""
    count, farthest, first, row = 0, -1.0, 0, places[:1].size
    rows = max(1, BLOCK_VALUES // max(row, 1))
    for start in range(0, len(places), rows):
        far = np.abs(places[start : start + rows].astype(np.float64))
        far = np.nan_to_num(far, copy=False, posinf=0.0)  # those are another check's
        count += int((far > FARTHEST_M).sum())
        if far.size and far.max() > farthest:
            farthest, first = float(far.max()), start * row + int(far.argmax())
    return count, farthest, tuple(int(i) for i in np.unravel_index(first, places.shape))


def check_visibility(measured: Measured, findings: Findings) -> None:
    """Frames and points that were never seen."""
    where = ["scene.npz", "visible"]
    seen = measured.seen
    frames, count = seen.shape
    if not seen.any():
        findings.fault(where, f"all {count} points are invisible in all {frames} frames")
        return
    if not seen[0].any():
        findings.fault(where, f"all {count} points are invisible in frame 0, where every prediction starts")
    blind = np.flatnonzero(~seen.any(axis=1))
    if len(blind):
        findings.warn(where, f"nothing is visible in {len(blind)} of {frames} frames: {some(blind)}")
    never = np.flatnonzero(~seen.any(axis=0))
    if len(never):
        findings.warn(where, f"{len(never)} of {count} points are never visible: {some(never)}")
    zeros = seen & (measured.points == 0.0).all(axis=2)
    if zeros.sum() > 1:
        t, i = np.argwhere(zeros)[0]
        findings.warn(
            where,
            f"{int(zeros.sum())} visible values are exactly (0, 0, 0), first in frame {t} point {i}:"
            " were they meant to be invisible?",
        )


def check_units(measured: Measured, findings: Findings) -> None:
    """A size that metres allow."""
    where = ["scene.npz", "points"]
    size = measured.size_m
    if measured.seen[measured.first_frame].sum() < 2:
        return
    if size > LARGEST_OBJECT_M or size < SMALLEST_OBJECT_M:
        word, bound = ("more", LARGEST_OBJECT_M) if size > LARGEST_OBJECT_M else ("less", SMALLEST_OBJECT_M)
        findings.fault(
            where, f"the object measures {size:.4g} m, {word} than {bound:g} m: not metres?{unit_hint(size)}"
        )
    elif size > PLAUSIBLE_OBJECT_M[1]:
        findings.warn(where, f"the object measures {size:.4g} m: not metres?{unit_hint(size)}")


def check_controllers(measured: Measured, object_size_m: float, findings: Findings) -> None:
    """Controllers that come near the object at some time."""
    from scipy.spatial import cKDTree  # for uploads only; it takes as long to import as the API's own routes

    where = ["scene.npz", "controllers"]
    if not measured.controllers.shape[1] or not measured.seen.any() or object_size_m <= 0.0:
        return
    frames = np.flatnonzero(measured.seen.any(axis=1))
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, CONTROL_CHECK_FRAMES).astype(int))]
    closest = np.full(measured.controllers.shape[1], np.inf)
    for t in frames:
        distance, _ = cKDTree(measured.points[t, measured.seen[t]]).query(measured.controllers[t])
        closest = np.minimum(closest, distance)
    sizes = closest / object_size_m
    for limit, report in ((FAR_CONTROLLER_FAULT, findings.fault), (FAR_CONTROLLER_WARNING, findings.warn)):
        far = np.flatnonzero(sizes > limit)
        if len(far):
            worst = far[np.argmax(sizes[far])]
            report(
                where,
                f"{len(far)} of {len(sizes)} never come nearer to the object than {limit:g} of its sizes"
                f" ({object_size_m:.3g} m): {some(far)}; controller {worst} stays"
                f" {closest[worst]:.4g} m away, {sizes[worst]:.3g} sizes: another frame or unit?",
            )
            return


def check_control_times(arrays: dict[str, Array], times: Array, findings: Findings) -> None:
    """The controllers' own clock runs forward and covers the recording to within a frame."""
    where = ["scene.npz", "ctrl_times"]
    if "ctrl_times" not in arrays or arrays["ctrl_times"].ndim != 1 or not len(arrays["ctrl_times"]):
        return
    clock = np.asarray(arrays["ctrl_times"], dtype=np.float64)
    if not (np.isfinite(clock).all() and np.isfinite(times).all()):
        return
    back = np.diff(clock) <= 0.0
    if back.any():
        i = int(np.argmax(back)) + 1
        findings.fault(where, f"does not increase at sample {i}: {clock[i]:.6g} s after {clock[i - 1]:.6g} s")
    frame = float(np.median(np.diff(times)))
    if clock[0] > times[0] + frame or clock[-1] < times[-1] - frame:
        findings.fault(
            where,
            f"covers {clock[0]:.4g} to {clock[-1]:.4g} s, the recording {times[0]:.4g} to {times[-1]:.4g} s",
        )


def hold(values: Array, valid: Array) -> Array:
    """``values`` (T, N, 3) where ``valid`` (T, N), else the last valid one, before any the first, else 0."""
    frames = np.arange(len(valid))[:, None]
    last = np.maximum.accumulate(np.where(valid, frames, -1), axis=0)
    source = np.where(last >= 0, last, np.argmax(valid, axis=0)[None])
    held = np.take_along_axis(values, source[..., None], axis=0)
    return np.where(np.any(valid, axis=0, keepdims=True)[..., None], held, 0.0)


def unit_hint(size_m: float) -> str:
    """Which unit would make this size plausible, with the factor to metres; empty when none does."""
    low, high = PLAUSIBLE_OBJECT_M
    fitting = [f"{unit}: multiply by {f:g}" for unit, f in UNIT_FACTORS.items() if low <= size_m * f <= high]
    return f" (likely {' or '.join(fitting)})" if fitting else ""


def _check_shape(
    name: str,
    array: Array,
    wanted: tuple[str | int, ...],
    lengths: dict[str, tuple[int, str]],
    findings: Findings,
) -> bool:
    """Whether dimensions and type are right; a length that disagrees is named with the array that set it."""
    where = ["scene.npz", name]
    text = "(" + ", ".join(str(d) for d in wanted) + ("," if len(wanted) == 1 else "") + ")"
    if array.ndim != len(wanted) or any(
        isinstance(d, int) and d != n for d, n in zip(wanted, array.shape, strict=True)
    ):
        findings.fault(where, f"has shape {array.shape}, not {text}")
        return False
    if name == "visible":
        if array.dtype.kind != "b" and not np.isin(array, (0, 1)).all():
            findings.fault(where, f"holds {array.dtype} values other than 0 and 1")
            return False
    elif array.dtype.kind not in "fiu":
        findings.fault(where, f"holds {array.dtype}, not numbers")
        return False
    agrees = True
    for letter, length in zip(wanted, array.shape, strict=True):
        if isinstance(letter, str):
            known, owner = lengths.setdefault(letter, (length, name))
            if known != length:
                findings.fault(
                    where, f"has shape {array.shape}: {letter} is {length} here and {known} in {owner}"
                )
                agrees = False
    if name in NEVER_EMPTY and not len(array):
        findings.fault(where, "is empty")
    return agrees


def _check_others(arrays: dict[str, Array], findings: Findings) -> None:
    """Arrays of more than one allowed shape, and those that no code here reads: plain numbers at least."""
    points = arrays.get("points")
    for name, array in arrays.items():
        where = ["scene.npz", name]
        if name not in ARRAY_SHAPES and array.dtype.kind not in "biuf":
            findings.fault(where, f"holds {array.dtype}, not numbers")
        elif name == "colors" and points is not None and array.shape not in (points.shape, points.shape[1:]):
            findings.fault(where, f"has shape {array.shape}, neither {points.shape} nor {points.shape[1:]}")
        elif name == "part_features":
            volume = arrays.get("rest_volume_points", np.zeros((0, 3)))
            owners = {len(volume), 0 if points is None or points.ndim < 2 else points.shape[1]} - {0}
            if array.ndim != 2 or len(array) not in owners:
                counts = " or ".join(str(n) for n in sorted(owners))
                findings.fault(where, f"has shape {array.shape}, not (points, features) for {counts} points")
            else:
                _check_finite(name, array, findings)


def _check_finite(name: str, array: Array, findings: Findings) -> None:
    bad = ~np.isfinite(np.asarray(array, dtype=np.float64))
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        value = array[first]
        findings.fault(
            ["scene.npz", name],
            f"{int(bad.sum())} of {bad.size} values are not finite, first {value} at {first}",
        )


def _measure(arrays: dict[str, Array], findings: Findings) -> Measured:
    points = np.asarray(arrays["points"], dtype=np.float64)
    visible = np.asarray(arrays["visible"]).astype(bool)
    finite: Array = np.all(np.isfinite(points), axis=2)
    lost = visible & ~finite
    if lost.any():
        t, i = np.argwhere(lost)[0]
        findings.fault(
            ["scene.npz", "points"],
            f"{int(lost.sum())} of {int(visible.sum())} visible points are not finite,"
            f" first in frame {t} point {i}: {points[t, i].tolist()}",
        )
    seen = visible & finite
    cleaned = np.where(seen[..., None], points, 0.0)
    controllers = np.asarray(arrays["controllers"], dtype=np.float64)
    known: Array = np.all(np.isfinite(controllers), axis=2)
    controllers = hold(controllers, known)
    t = int(np.argmax(seen.any(axis=1)))
    size = float(np.linalg.norm(np.ptp(cleaned[t, seen[t]], axis=0))) if seen.any() else 0.0
    times = np.asarray(arrays["times"], dtype=np.float64)
    return Measured(cleaned, seen, controllers, times, size)


def some(indices: Array) -> str:
    """The first few of them, and how many there are."""
    shown = ", ".join(str(int(i)) for i in indices[:NAMED_AT_MOST])
    return shown if len(indices) <= NAMED_AT_MOST else f"{shown}, … ({len(indices)} in all)"
