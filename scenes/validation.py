"""The scene validator: one pass that names every fault of a scene with its numbers.

Faults make a scene unusable; warnings travel with it. The checks are in ``scene_declaration`` (the form of
``scene.json``), ``scene_checks_measured`` (the arrays) and ``scene_checks_declared`` (both together).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld_scenes.checks_colliders import check_colliders
from physworld_scenes.checks_declared import (
    check_body,
    check_gravity,
    check_grips,
    check_ground,
    check_noise,
    check_split,
    declared_size_m,
)
from physworld_scenes.checks_measured import (
    Findings,
    Measured,
    check_arrays,
    check_control_times,
    check_controllers,
    check_jumps,
    check_times,
    check_units,
    check_visibility,
)
from physworld_scenes.checks_places import check_places
from physworld_scenes.declaration import Declaration, check_form
from physworld_schemas.base import FieldError


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
    check_body(declaration, measured, findings)
    check_grips(declaration, arrays, measured, findings)
    check_colliders(declaration, arrays, meshes, measured, size, findings)
    if declaration.ground is not None and measured.seen.any():
        check_ground(declaration.ground, max(declaration.noise_sigma_m or 0.0, 0.0), measured, findings)
