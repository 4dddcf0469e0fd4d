"""Checks of a scene's colliders: names, sizes, meshes that close, poses that are poses, and who carries them.

Thresholds stand at the top with their reasons. Faults and warnings as in ``scene_checks_measured``.
"""

from __future__ import annotations

import math

import numpy as np

from physworld.arrays import Array
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld_scenes.checks_measured import Findings, Measured
from physworld_scenes.declaration import ColliderForm, Declaration
from physworld_scenes.meshes import mesh_path_fault

LARGEST_SIZES, SMALLEST_SIZES = 100.0, 0.01
"""Longest side of a collider over the object's size: a floor or a table at most, the tip of a needle at least."""

UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from 1: rounding of written numbers, not another convention."""

FRICTION_WARNING = 2.0

Where = list[str | int]


def check_colliders(
    declaration: Declaration,
    arrays: dict[str, Array],
    meshes: dict[str, SurfaceMesh],
    measured: Measured,
    object_size_m: float,
    findings: Findings,
) -> None:
    """All colliders of a declaration.

    Args:
        declaration: the form.
        arrays: those in ``scene.npz``.
        meshes: mesh files by their path in the bundle, those that could be read.
        measured: the arrays that agree.
        object_size_m: diagonal of the object.
        findings: where faults and warnings go.
    """
    names: set[str] = set()
    owner = {i: f"grip {g}" for g, grip in enumerate(declaration.grips or []) for i in grip.controllers}
    for number, collider in enumerate(declaration.colliders or []):
        where: Where = ["scene.json", "colliders", number]
        if collider.name in names:
            findings.fault([*where, "name"], f"is {collider.name!r}, as another collider's")
        names.add(collider.name)
        _check_size(collider, meshes, object_size_m, where, findings)
        _check_quaternions(np.array([collider.quaternion_wxyz]), [*where, "quaternion_wxyz"], findings)
        _check_carriers(collider, owner, measured.controllers.shape[1], where, findings)
        if collider.poses is not None:
            _check_poses(collider.poses, arrays, where, findings)
        if collider.friction is not None and collider.friction > FRICTION_WARNING:
            findings.warn([*where, "friction"], f"is {collider.friction:g}; rubber on rubber has about 1.2")


def _check_size(
    collider: ColliderForm,
    meshes: dict[str, SurfaceMesh],
    object_size_m: float,
    where: Where,
    findings: Findings,
) -> None:
    if collider.shape == "half_space":
        return
    if collider.shape == "mesh":
        path = collider.mesh or ""
        fault = mesh_path_fault(path)
        if fault is not None:
            findings.fault([*where, "mesh"], fault)
        if path not in meshes:
            return
        fault = meshes[path].fault()
        if fault is not None:
            findings.fault([*where, "mesh"], f"{path} {fault}")
            return
        longest, key = float(meshes[path].size_m.max()), "mesh"
    else:
        sizes = [2 * (collider.radius_m or 0.0), collider.length_m or 0.0, *(collider.size_m or ())]
        longest, key = max(sizes), "size_m" if collider.shape == "box" else "radius_m"
    if object_size_m <= 0.0:
        return
    factor = longest / object_size_m
    if not SMALLEST_SIZES <= factor <= LARGEST_SIZES:
        near = [f for f in (100.0, 1000.0) if 0.05 < factor / f < 20.0 or 0.05 < 1 / (factor * f) < 20.0]
        hint = f": do their units differ by {near[-1]:g}?" if near else ""
        findings.fault(
            [*where, key],
            f"is {longest:.4g} m long beside an object of {object_size_m:.4g} m, {factor:.3g} times{hint}",
        )


def _check_carriers(
    collider: ColliderForm, owner: dict[int, str], count: int, where: Where, findings: Findings
) -> None:
    place = [*where, "controllers"]
    if collider.controllers and collider.poses is not None:
        findings.fault(place, f"carry it, and so does the array {collider.poses!r}: one of the two")
    outside = [i for i in collider.controllers if i >= count]
    if outside:
        findings.fault(place, f"names {outside[:5]}, there are {count} (0 to {count - 1})")
    if len(set(collider.controllers)) != len(collider.controllers):
        findings.fault(
            place, f"names {len(collider.controllers) - len(set(collider.controllers))} of them twice"
        )
    for i in set(collider.controllers):
        if owner.setdefault(i, f"collider {collider.name!r}") != f"collider {collider.name!r}":
            findings.fault(place, f"names controller {i}, which {owner[i]} has")
    if len(collider.controllers) in (1, 2):
        findings.warn(place, f"are {len(collider.controllers)}: three or more show a full rotation")


def _check_poses(name: str, arrays: dict[str, Array], where: Where, findings: Findings) -> None:
    place = [*where, "poses"]
    poses = arrays.get(name)
    if poses is None:
        findings.fault(place, f"is {name!r}; scene.npz holds {', '.join(sorted(arrays))}")
        return
    lengths = {
        len(arrays["times"]),
        len(arrays["ctrl_times"]) if "ctrl_times" in arrays else len(arrays["times"]),
    }
    if (
        poses.ndim != 2
        or poses.shape[1] != 7
        or poses.shape[0] not in lengths
        or poses.dtype.kind not in "fiu"
    ):
        wanted = " or ".join(f"({length}, 7)" for length in sorted(lengths))
        findings.fault(place, f"{name} has shape {poses.shape} of {poses.dtype}, not {wanted}")
        return
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        findings.fault(
            place, f"{name} is not finite in {int(bad.sum())} poses, first in {int(np.argmax(bad))}"
        )
        return
    _check_quaternions(np.asarray(poses[:, 3:], dtype=float), place, findings)


def _check_quaternions(quaternions: Array, where: Where, findings: Findings) -> None:
    lengths = np.linalg.norm(quaternions, axis=1)
    worst = int(np.argmax(np.abs(lengths - 1.0)))
    if not math.isclose(lengths[worst], 1.0, abs_tol=UNIT_TOLERANCE):
        findings.fault(
            where,
            f"has a quaternion {np.round(quaternions[worst], 4).tolist()} of length {lengths[worst]:.4g}, not 1",
        )
