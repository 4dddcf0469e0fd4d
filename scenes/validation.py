"""The scene validator: one pass that names every fault of a scene with its numbers.

Faults make a scene unusable; warnings travel with it. The form of ``scene.json`` is checked in ``declaration``, the
arrays in ``measured``, colliders in ``colliders``, noise in ``noise``, and what is declared against the arrays
here: split, gravity, body, grips, ground. Thresholds stand at the top with their reasons.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld_scenes.colliders import check_colliders
from physworld_scenes.declaration import BodyForm, Declaration, GripForm, GroundForm, check_form
from physworld_scenes.jumps import check_jumps
from physworld_scenes.measured import (
    Findings,
    Measured,
    check_arrays,
    check_control_times,
    check_controllers,
    check_places,
    check_times,
    check_units,
    check_visibility,
)
from physworld_scenes.noise import check_covariances, check_noise
from physworld_schemas.base import FieldError

STANDARD_GRAVITY = 9.80665
GRAVITY_ALLOWED = (1.5, 15.0)
"""Moon to a little more than Earth; beyond, the unit is wrong. Zero passes with a warning."""
GRAVITY_USUAL = (9.76, 9.84)
"""On the Earth's surface, pole to equator."""
TILT_WARNING_DEGREES = 1.0

DENSITY_ALLOWED = (5.0, 25_000.0)
"""Aerogel excepted, lighter than any foam to heavier than osmium."""
DENSITY_USUAL = (10.0, 9_000.0)
MASS_ALLOWED = 1_000.0
MASS_FACTOR_WARNING = 5.0
"""Mass over (density x declared box): a body fills at most its box; a tenth of it is still a thick shell."""

EXTENT_FAULT = 8.0
"""Measured over declared size, or the other way with the controllers included, at which a unit is wrong."""
EXTENT_WARNING = 1.6
MANY_POINTS = 20
"""So many tracked points cover an undeformed body, so their box is the body's."""

GROUND_FAULT_SIZES = 0.1
GROUND_WARNING_SIZES = 0.02
GROUND_TOLERANCE_SIGMAS = 6.0
"""How deep a point may lie under the ground: noise, and a table plane that was fitted to depth images."""
REGION_TOLERANCE_SIZES = 0.01


def check_scene(
    declared: dict[str, Any], arrays: dict[str, Array], meshes: dict[str, SurfaceMesh] | None = None
) -> tuple[list[FieldError], list[str]]:
    """Faults and warnings of a scene as it lies in its files.

    Args:
        declared: the object in ``scene.json``.
        arrays: the arrays in ``scene.npz`` under the names that they have there.
        meshes: meshes of colliders that could be read, by the path that ``scene.json`` names.
    """
    declaration, form_faults = check_form(declared)
    findings = Findings(faults=form_faults)
    if declaration is not None:
        check_gravity(declaration, findings)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd values overflow, and are then named
        measured = check_arrays(arrays, findings)
        if measured is not None and check_places(arrays, measured, findings):
            _check_measured(declaration, arrays, meshes or {}, measured, findings)
    return findings.faults, findings.warnings


def _check_measured(
    declaration: Declaration | None,
    arrays: dict[str, Array],
    meshes: dict[str, SurfaceMesh],
    measured: Measured,
    findings: Findings,
) -> None:
    check_times(measured.times, None if declaration is None else declaration.fps, findings)
    check_control_times(arrays, measured.times, findings)
    check_visibility(measured, findings)
    check_units(measured, findings)
    check_jumps(measured, findings)
    declared_size = None if declaration is None else declared_size_m(declaration.body)
    size = max(measured.size_m, declared_size or 0.0)
    check_controllers(measured, size, findings)
    if declaration is None:
        return
    check_split(declaration, measured, findings)
    check_noise(declaration, size, findings)
    check_covariances(declaration, arrays, findings)
    check_body(declaration, measured, findings)
    check_grips(declaration, arrays, measured, findings)
    check_colliders(declaration, arrays, meshes, measured, size, findings)
    if declaration.ground is not None and measured.seen.any():
        check_ground(declaration.ground, max(declaration.noise_sigma_m or 0.0, 0.0), measured, findings)


def check_split(declaration: Declaration, measured: Measured, findings: Findings) -> None:
    """Two ranges inside the recording that do not overlap, with something seen in both."""
    where = ["scene.json", "split"]
    frames = len(measured.times)
    ranges = {"train": declaration.split.train, "test": declaration.split.test}
    for name, (first, last) in ranges.items():
        if first < 0 or last > frames:
            findings.fault([*where, name], f"[{first}, {last}) reaches outside the {frames} frames")
        elif last <= first:
            findings.fault([*where, name], f"[{first}, {last}) is empty")
        elif not measured.seen[first:last].any():
            findings.fault([*where, name], f"nothing is visible in its frames [{first}, {last})")
    (a, b), (c, d) = ranges["train"], ranges["test"]
    overlap = min(b, d) - max(a, c)
    if overlap > 0 and b > a and d > c:
        findings.fault(where, f"train [{a}, {b}) and test [{c}, {d}) share {overlap} frames")
    if a != 0 and 0 <= a < b:
        findings.warn([*where, "train"], f"starts at frame {a}; every prediction starts at frame 0")


def check_gravity(declaration: Declaration, findings: Findings) -> None:
    """Metres per second squared, downwards along -z."""
    where = ["scene.json", "gravity_m_s2"]
    strength = math.hypot(*declaration.gravity_m_s2)
    if strength == 0.0:
        findings.warn(where, "is zero: nothing falls")
        return
    if not GRAVITY_ALLOWED[0] <= strength <= GRAVITY_ALLOWED[1]:
        units = {
            "mm/s2: divide by 1000": 1e-3,
            "cm/s2: divide by 100": 1e-2,
            "g: multiply by 9.80665": 9.80665,
        }
        fit = [u for u, f in units.items() if GRAVITY_USUAL[0] <= strength * f <= GRAVITY_USUAL[1]]
        hint = f" (likely {fit[0]})" if fit else ""
        findings.fault(where, f"has strength {strength:.5g} m/s2, outside {GRAVITY_ALLOWED}{hint}")
    elif not GRAVITY_USUAL[0] <= strength <= GRAVITY_USUAL[1]:
        findings.warn(where, f"has strength {strength:.5g} m/s2; on Earth it is {STANDARD_GRAVITY:.4g}")
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, -declaration.gravity_m_s2[2] / strength))))
    if tilt > 90.0 + TILT_WARNING_DEGREES:
        findings.fault(where, f"points up, {tilt:.1f} degrees from -z: the world frame is z up")
    elif tilt > TILT_WARNING_DEGREES:
        findings.warn(where, f"points {tilt:.1f} degrees away from -z: the world frame is z up")


def check_body(declaration: Declaration, measured: Measured, findings: Findings) -> None:
    """Declared sizes, density, mass and topology against each other and against what was measured."""
    body = declaration.body
    where = ["scene.json", "body"]
    if body.density_kg_m3 is not None:
        _check_density(body.density_kg_m3, findings)
    if body.mass_kg is not None and body.mass_kg > MASS_ALLOWED:
        findings.fault([*where, "mass_kg"], f"is {body.mass_kg:g} kg, more than {MASS_ALLOWED:g} kg")
    if body.mass_kg is not None and body.density_kg_m3 is not None and body.size_m is not None:
        full = body.density_kg_m3 * math.prod(body.size_m)
        factor = body.mass_kg / full if full > 0.0 else math.inf  # sizes multiply to less than a float holds
        if not 1.0 / (2.0 * MASS_FACTOR_WARNING) <= factor <= MASS_FACTOR_WARNING:
            findings.warn(
                [*where, "mass_kg"],
                f"is {body.mass_kg:g} kg; the declared box full of {body.density_kg_m3:g} kg/m3 weighs {full:.4g} kg",
            )
    if (body.box_min_m is None) != (body.box_max_m is None):
        findings.fault([*where, "box_min_m"], "box_min_m and box_max_m come together or not at all")
    elif body.box_min_m is not None and body.box_max_m is not None:
        _check_box(body.box_min_m, body.box_max_m, [*where, "box_min_m"], findings)
        _check_box_size(body, findings)
    _check_topology(body, measured.points.shape[1], findings)
    _check_extent(declaration, measured, findings)


def check_grips(
    declaration: Declaration, arrays: dict[str, Array], measured: Measured, findings: Findings
) -> None:
    """Indices in range, each controller in one grip, boxes that hold material.

    Args:
        declaration: ``scene.json`` as parsed.
        arrays: ``scene.npz``, for boxes that need them.
        measured: points and controllers that are shaped alike.
        findings: takes faults and warnings.
    """
    owner: dict[int, int] = {}
    controllers, count = measured.controllers.shape[1], measured.points.shape[1]
    for g, grip in enumerate(declaration.grips or []):
        where: list[str | int] = ["scene.json", "grips", g]
        if not grip.controllers:
            findings.fault([*where, "controllers"], "is empty")
        for name, indices, length in (
            ("controllers", grip.controllers, controllers),
            ("points", grip.points, count),
        ):
            outside = [i for i in indices if i >= length]
            if outside:
                findings.fault([*where, name], f"names {outside[:5]}, there are {length} (0 to {length - 1})")
            if len(set(indices)) != len(indices):
                findings.fault([*where, name], f"names {len(indices) - len(set(indices))} of them twice")
        for i in grip.controllers:
            if owner.setdefault(i, g) != g:
                findings.fault([*where, "controllers"], f"names controller {i}, which grip {owner[i]} holds")
        _check_open(grip, measured, [*where, "open_s"], findings)
        if any(begin <= 0.0 < end for begin, end in grip.open_s):
            continue  # what it holds at the first frame is nothing
        _check_region(grip, declaration, arrays, measured, [*where, "region_min_m"], findings)
        if grip.radius_m is not None and all(i < controllers for i in grip.controllers):
            _check_radius(grip, grip.radius_m, declaration, measured, [*where, "radius_m"], findings)


def _check_open(grip: GripForm, measured: Measured, where: list[str | int], findings: Findings) -> None:
    """Times at which a grip is open: in their order, within the recording."""
    before, last = 0.0, float(measured.times[-1] - measured.times[0])
    for begin, end in grip.open_s:
        if not (before <= begin < end):
            findings.fault(
                where,
                f"has {begin:g} to {end:g} s after {before:g} s; each begins before it ends, one after another",
            )
            return
        if begin > last:
            findings.warn(where, f"begins at {begin:g} s, after the last frame at {last:g} s")
        before = end


def check_ground(ground: GroundForm, noise_sigma_m: float, measured: Measured, findings: Findings) -> None:
    """A plane under the object.

    Args:
        ground: as declared.
        noise_sigma_m: per axis [m]; it sets how far a point may be below.
        measured: points, what is seen of them, and the object's size.
        findings: takes faults and warnings.
    """
    where = ["scene.json", "ground", "height_m"]
    noise = GROUND_TOLERANCE_SIGMAS * noise_sigma_m
    tolerance = max(noise, GROUND_FAULT_SIZES * measured.size_m)
    first = measured.first_frame
    lowest = [
        points[seen, 2].min(initial=np.inf)
        for points, seen in zip(measured.points, measured.seen, strict=True)
    ]
    depth = ground.height_m - np.array(lowest)
    if depth[first] > tolerance:
        height = np.where(measured.seen[first], measured.points[first, :, 2], np.inf)
        under = int((height < ground.height_m - tolerance).sum())
        i = int(np.argmin(height))
        findings.fault(
            where,
            f"is {ground.height_m:.4g} m, and point {i} lies {depth[first]:.4g} m below it in frame {first}"
            f" ({under} points do; allowed {tolerance:.2g} m)",
        )
    elif depth.max() > max(noise, GROUND_WARNING_SIZES * measured.size_m):
        t = int(np.argmax(depth))
        findings.warn(
            where,
            f"is {ground.height_m:.4g} m, and the object reaches {depth[t]:.4g} m below it in frame {t}",
        )
    if ground.friction is not None and ground.friction > 2.0:
        findings.warn(
            ["scene.json", "ground", "friction"], f"is {ground.friction:g}; rubber on rubber has about 1.2"
        )


def declared_size_m(body: BodyForm) -> float | None:
    """Diagonal of the declared body [m], or None when nothing is declared."""
    if body.size_m is not None:
        return math.hypot(*body.size_m)
    if body.box_min_m is not None and body.box_max_m is not None:
        return math.dist(body.box_min_m, body.box_max_m)
    if body.length_m is not None:
        return body.length_m
    if body.side_m is not None:
        return math.sqrt(2.0) * body.side_m
    return None


def _check_density(density: float, findings: Findings) -> None:
    where = ["scene.json", "body", "density_kg_m3"]
    if not DENSITY_ALLOWED[0] <= density <= DENSITY_ALLOWED[1]:
        hint = " (likely g/cm3: multiply by 1000)" if density < DENSITY_ALLOWED[0] else ""
        findings.fault(where, f"is {density:g} kg/m3, outside {DENSITY_ALLOWED}{hint}")
    elif not DENSITY_USUAL[0] <= density <= DENSITY_USUAL[1]:
        findings.warn(where, f"is {density:g} kg/m3, unusual for a deformable object")


def _check_box(
    low: tuple[float, ...], high: tuple[float, ...], where: list[str | int], findings: Findings
) -> bool:
    bad = [axis for axis, a, b in zip("xyz", low, high, strict=True) if not a < b]
    if bad:
        findings.fault(where, f"{list(low)} is not below {list(high)} in {', '.join(bad)}")
    return not bad


def _check_box_size(body: BodyForm, findings: Findings) -> None:
    if body.size_m is None or body.box_min_m is None or body.box_max_m is None:
        return
    box, where = np.subtract(body.box_max_m, body.box_min_m), ["scene.json", "body", "size_m"]
    if (box > 0).all() and not np.allclose(box, body.size_m, rtol=0.1):
        findings.fault(where, f"is {list(body.size_m)}, the box measures {box.round(6).tolist()}")


def _check_topology(body: BodyForm, count: int, findings: Findings) -> None:
    where = ["scene.json", "body", "topology"]
    edges, n = (None, None) if body.topology is None else (body.topology.edges, body.topology.n)
    if edges is not None:
        outside = [list(pair) for pair in edges if max(pair) >= count]
        if outside:
            findings.fault([*where, "edges"], f"{len(outside)} name points beyond the {count}: {outside[:3]}")
        if any(a == b for a, b in edges):
            findings.fault([*where, "edges"], "one joins a point to itself")
    if n is not None and n**2 != count:
        findings.fault([*where, "n"], f"is {n}, a grid of {n * n} points; there are {count}")
    lengths = body.segment_rest_lengths_m
    expected = len(edges) if edges is not None else count - 1
    if lengths is not None and len(lengths) != expected:
        findings.fault(
            ["scene.json", "body", "segment_rest_lengths_m"],
            f"has {len(lengths)} entries for {expected} segments of {count} points",
        )


def _check_extent(declaration: Declaration, measured: Measured, findings: Findings) -> None:
    """Declared size against the box of the points (and, downwards, of points and controllers)."""
    declared = declared_size_m(declaration.body)
    if declared is None or not measured.seen.any():
        return
    where = ["scene.json", "body", "size_m"]
    first = measured.first_frame
    cloud = np.concatenate([measured.points[first, measured.seen[first]], measured.controllers[first]])
    whole = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    larger = measured.size_m / declared
    smaller = declared / whole if whole > 0.0 else math.inf
    factor = max(larger, smaller)
    if factor > EXTENT_FAULT and len(cloud) > 1:
        size = measured.size_m if larger > smaller else whole
        near = [f for f in (10.0, 100.0, 1000.0) if 0.5 < factor / f < 2.0]
        hint = f": do their units differ by {near[0]:g}?" if near else ""
        findings.fault(
            where, f"declares {declared:.4g} m, measured are {size:.4g} m, {factor:.3g} times off{hint}"
        )
        return
    covered = declaration.initial_state.startswith("undeformed") and measured.seen[first].sum() >= MANY_POINTS
    if larger > EXTENT_WARNING or (covered and declared > EXTENT_WARNING * measured.size_m):
        findings.warn(
            where, f"declares {declared:.4g} m, the points of frame {first} measure {measured.size_m:.4g} m"
        )


def _check_region(
    grip: GripForm,
    declaration: Declaration,
    arrays: dict[str, Array],
    measured: Measured,
    where: list[str | int],
    findings: Findings,
) -> None:
    """The grip's box holds undeformed material: volume points, else part of the declared box, else points."""
    if grip.region_min_m is None and grip.region_max_m is None:
        return
    if grip.region_min_m is None or grip.region_max_m is None:
        findings.fault(where, "region_min_m and region_max_m come together or not at all")
        return
    if not _check_box(grip.region_min_m, grip.region_max_m, where, findings):
        return
    body = declaration.body
    margin = REGION_TOLERANCE_SIZES * max(measured.size_m, declared_size_m(body) or 0.0)
    volume = arrays.get("rest_volume_points")
    if volume is not None and volume.dtype.kind in "fiu" and volume.shape[1:] == (3,) and len(volume):
        material, what = np.asarray(volume, dtype=np.float64), f"{len(volume)} volume points"
    elif body.box_min_m is not None and body.box_max_m is not None:
        middle = np.add(grip.region_min_m, grip.region_max_m) / 2.0
        nearest = np.clip(middle, body.box_min_m, body.box_max_m)
        material, what = nearest[None], "declared body's box"
    else:
        first = measured.first_frame
        margin = 0.05 * measured.size_m
        material, what = measured.points[first, measured.seen[first]], "visible points of the first frame"
    low, high = np.subtract(grip.region_min_m, margin), np.add(grip.region_max_m, margin)
    if not ((material >= low) & (material <= high)).all(axis=1).any():
        findings.fault(
            where,
            f"the region {list(grip.region_min_m)} to {list(grip.region_max_m)} holds none of the {what}",
        )


def _check_radius(
    grip: GripForm,
    radius_m: float,
    declaration: Declaration,
    measured: Measured,
    where: list[str | int],
    findings: Findings,
) -> None:
    """No box beside it; and some material lies within it at the first frame, as far as the scene shows that."""
    if grip.region_min_m is not None or grip.region_max_m is not None:
        findings.fault(where, "a grip holds what is in its region or within its radius, not both")
        return
    if not grip.controllers:
        return
    at = measured.controllers[0, grip.controllers]
    first, body = measured.first_frame, declaration.body
    points = measured.points[first, measured.seen[first]]
    nearest, what = float(np.linalg.norm(at[:, None] - points, axis=2).min()), "visible point"
    most, report = radius_m, findings.warn
    if declaration.initial_state.startswith("undeformed") and None not in (body.box_min_m, body.box_max_m):
        inside = np.clip(at, body.box_min_m, body.box_max_m)
        nearest, what = float(np.linalg.norm(at - inside, axis=1).min()), "place in the declared body's box"
        most, report = radius_m + REGION_TOLERANCE_SIZES * measured.size_m, findings.fault
    if nearest > most:
        report(where, f"is {radius_m:.4g} m, the nearest {what} is {nearest:.4g} m from a controller")
