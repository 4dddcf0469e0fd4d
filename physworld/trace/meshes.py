"""Sheets that another engine recorded as a mesh: the discretisation of the recorder as a suspect.

A recording of a sheet by linear triangles and hinges shows its mesh: 16 cells a side part from their own refinement by
more than most effects do, and no plate of ours comes to the noise (ADR 21). Which meshes it may be shows in where their
lines lie: on the ends of the declared grips. Which one it is shows early: a sheet that is let go wrinkles at once, cell
by cell, while what an effect does and the scene does not declare grows with time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.build import build_twin
from physworld.geometry.sheet_body import possible_meshes
from physworld.materials.sheet import SheetLaw
from physworld.mpm.triangles import Mesh
from physworld.scene import Scene
from physworld.simulations import Job
from physworld.trace.simulations import Simulations
from physworld.twin import Twin

_WINDOWS = (0.375, 0.5, 0.625, 0.75)  # shares of the training frames, from their beginning
_STIFFNESSES = tuple(0.05 * k for k in range(-5, 6))  # logarithms, over the plate's
_NEARER = (-0.03, -0.015, 0.015, 0.03)  # about the best of those
MESH_STIFFNESS = 0.06
"""How far the logarithm of a mesh's stiffness may lie from what its first frames say: all windows see it to 0.015."""
MESH_STARTS = tuple(0.01 * k for k in (-4, -3, -2, -1, 1, 2, 3, 4))
"""From which a mesh's stiffness is searched: wrinkles make valleys of some percent, in which others make up for it."""
_CLEARLY = 0.9  # share of the plate's squared errors
_BEST = 4  # bodies that are looked at more nearly


def recorded_as(scene: Scene, plate: Twin, simulations: Simulations, frames: int) -> list[Twin]:
    """What a sheet may be, in the order of belief: a plate, and the best mesh where it follows the first frames better.

    Errors of several windows are added up, so that early frames count more, and all of a body have one stiffness. A
    mesh comes first only where it does clearly better.

    Args:
        scene: the recording.
        plate: the declared physics, calibrated.
        simulations: of the recording.
        frames: that training may use.
    """
    sheet = isinstance(plate.law, SheetLaw) and plate.lattice.smooth
    meshes = possible_meshes(scene) if sheet else []
    if not meshes:
        return [plate]
    simulations.stage = "mesh of the recorder"
    windows = [max(round(share * frames), 2) for share in _WINDOWS]
    bodies = [plate, *(_meshed(build_twin(scene, mesh=mesh), plate) for mesh in meshes)]
    tried = [_stiffer(twin, shift) for twin in bodies for shift in _STIFFNESSES]
    early = _errors(scene, tried, simulations, windows[:2]).reshape(len(bodies), -1)
    leading = [k for k in np.argsort(early.min(axis=1))[:_BEST] if np.isfinite(early[k].min())]
    leading += [0] if 0 not in leading else []
    near = [
        [
            _stiffer(tried[len(_STIFFNESSES) * k + int(np.argmin(early[k]))], shift)
            for shift in (0.0, *_NEARER)
        ]
        for k in leading
    ]
    late = _errors(scene, [twin for own in near for twin in own], simulations, windows).reshape(len(near), -1)
    left = late.min(axis=1)
    own = left[leading.index(0)]
    best = int(np.argmin(left))
    if not left[best] < own:
        return [plate]
    mesh = near[best][int(np.argmin(late[best]))]
    return [mesh, plate] if left[best] < _CLEARLY * own else [plate, mesh]


def taken_as(mesh: Mesh) -> str:
    """What a report says of a sheet that was traced as a mesh."""
    text = f"{mesh.counts[0]}x{mesh.counts[1]}{'odd' if mesh.odd else ''}"
    return f"taken as a mesh that another engine recorded, {mesh}; physworld fit --mesh {text} fits it so"


def _meshed(mesh: Twin, plate: Twin) -> Twin:
    """A mesh of the plate's modulus that bends as its thickness says, with what else is known beforehand.

    A plate's Poisson's ratio may have made up for its being none.
    """
    law, prior = plate.law, mesh.law
    assert isinstance(law, SheetLaw) and isinstance(prior, SheetLaw)
    membrane = law.membrane_n_m * (1.0 - law.poissons_ratio**2) / (1.0 - prior.poissons_ratio**2)
    bending = membrane * plate.body.thickness_m**2 / 12.0
    return replace(
        mesh,
        law=replace(prior, membrane_n_m=membrane, bending_n_m=bending),
        air_drag_per_s=plate.air_drag_per_s,
        device=plate.device,
    )


def _stiffer(twin: Twin, shift: float) -> Twin:
    known = twin.parameters
    gain = float(np.exp(shift))
    return twin.with_parameters(
        membrane_n_m=gain * known["membrane_n_m"], bending_n_m=gain * known["bending_n_m"]
    )


def _errors(scene: Scene, twins: list[Twin], simulations: Simulations, windows: list[int]) -> np.ndarray:
    """Mean squared distances of the sightings from each twin's tracks [m^2], summed over windows; or infinite."""
    found = []
    seen = scene.visible[: windows[-1]]
    for tracks in simulations.run([Job(twin, windows[-1]) for twin in twins]):
        if tracks is None:
            found.append(np.inf)
            continue
        squares = np.where(seen, np.sum((tracks - scene.points[: windows[-1]]) ** 2, axis=2), 0.0)
        found.append(sum(float(squares[:end].sum()) / max(int(seen[:end].sum()), 1) for end in windows))
    return np.array(found)
