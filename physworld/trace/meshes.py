"""Sheets that another engine recorded as a mesh: the discretisation of the recorder as a suspect.

A recording of a sheet by linear triangles and hinges shows its mesh: 16 cells a side part from their own refinement by
more than most effects do, and no plate of ours comes to the noise (ADR 21). Which meshes it may be shows in where their
lines lie: on the ends of the declared grips. Which one it is shows early: a sheet that is let go wrinkles at once, cell
by cell, while what an effect does and the scene does not declare grows with time. But for one: controls that come late
show from the first frame on, so a plate that follows the first frames clearly better with a lag lends it to all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import effect
from physworld.engine.thin.triangles import Mesh
from physworld.estimation.simulations import Job
from physworld.geometry.sheet_body import possible_meshes
from physworld.materials.sheet import SheetLaw
from physworld.scene import Scene
from physworld.trace.simulations import Simulations
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

_WINDOWS = (0.375, 0.5, 0.625, 0.75)  # shares of the training frames, from their beginning
_STIFFNESSES = tuple(0.05 * k for k in range(-5, 6))  # logarithms, over the plate's
_FARTHER = tuple(0.05 * k for k in range(6, 11))  # looked at on the side where the best of those is the last
_NEARER = (-0.03, -0.015, 0.015, 0.03)  # about the best of those
MESH_STIFFNESS = 0.06
"""How far the logarithm of a mesh's stiffness may lie from what its first frames say: all windows see it to 0.015."""
MESH_STARTS = tuple(0.01 * k for k in (-4, -3, -2, -1, 1, 2, 3, 4))
"""From which a mesh's stiffness is searched: wrinkles make valleys of some percent, in which others make up for it."""
_CLEARLY = 0.9  # share of the plate's squared errors
_BEST = 4  # bodies that are looked at more nearly
_LAGS_S = tuple(0.01 * k for k in range(-4, 9))  # of the controls, tried with the plate
_NEARER_LAGS_S = (-0.004, 0.0, 0.004)  # about the one that was found


def recorded_as(scene: Scene, plate: Twin, simulations: Simulations, frames: int) -> list[Twin]:
    """What a sheet may be, in the order of belief: a plate, and the best mesh where it follows the first frames better.

    Errors of several windows are added up, so that early frames count more, and all of a body have one stiffness, and
    the lag of the controls if there is one. A
    mesh comes first only where it does clearly better. A sheet that touches itself is none, nor one of which neither
    thickness nor size is declared: a mesh bends as its thickness says.

    Args:
        scene: the recording.
        plate: the declared physics, calibrated.
        simulations: of the recording.
        frames: that training may use.
    """
    facts = scene.body
    sheet = isinstance(plate.law, SheetLaw) and plate.lattice.smooth and plate.self_friction is None
    known = facts.thickness_m is not None or facts.size_m is not None
    meshes = possible_meshes(scene) if sheet and known else []
    if not meshes:
        return [plate]
    simulations.stage = "mesh of the recorder"
    windows = [max(round(share * frames), 2) for share in _WINDOWS]
    bodies = [plate, *(_meshed(build_twin(scene, mesh=mesh), plate) for mesh in meshes)]
    compared = _Compared(scene, simulations, windows)
    lag = compared.lag_of(plate)
    shifts, least = compared.followed_best(bodies, lag)
    leading = [int(k) for k in np.argsort(least)[:_BEST] if np.isfinite(least[k])]
    leading += [0] if 0 not in leading else []
    near = [_stiffened([_stiffer(bodies[k], shifts[k])], (0.0, *_NEARER)) for k in leading]
    lags = [lag + off for off in _NEARER_LAGS_S] if lag else [0.0]
    late = np.stack([compared.errors([t for own in near for t in own], one, windows) for one in lags])
    late = late.min(axis=0).reshape(len(near), -1)
    left = late.min(axis=1)
    own = left[leading.index(0)]
    best = int(np.argmin(left))
    if not left[best] < own:
        return [plate]
    mesh = near[best][int(np.argmin(late[best]))]
    return [mesh, plate] if left[best] < _CLEARLY * own else [plate, mesh]


@dataclass(frozen=True)
class _Compared:
    """Bodies against the first frames of a recording: of windows that end at these frames."""

    scene: Scene
    simulations: Simulations
    windows: list[int]

    def lag_of(self, plate: Twin) -> float:
        """By how much the controls come late [s], if the plate follows the first frames clearly better so; else 0."""
        errors = self.errors([_late(plate, lag) for lag in _LAGS_S], 0.0, self.windows[:2])
        best = int(np.argmin(errors))
        if not errors[best] < _CLEARLY * errors[_LAGS_S.index(0.0)]:
            return 0.0
        if best in (0, len(errors) - 1) or not np.isfinite(errors[best - 1 : best + 2]).all():
            return _LAGS_S[best]
        before, least, after = errors[best - 1 : best + 2]  # of a parabola through the three
        step = _LAGS_S[best] - _LAGS_S[best - 1]
        return _LAGS_S[best] + 0.5 * step * float((before - after) / (before - 2.0 * least + after))

    def followed_best(self, bodies: list[Twin], lag: float) -> tuple[Array, Array]:
        """By which logarithm of its stiffness each body follows the first windows best, (B,), and its errors, (B,).

        Where the best is the last on either side it is looked for farther on: a plate may have made up for a coarse
        mesh, or for the lag.
        """
        windows = self.windows[:2]
        errors = self.errors(_stiffened(bodies, _STIFFNESSES), lag, windows)
        errors = errors.reshape(len(bodies), len(_STIFFNESSES))
        shifts, least = np.array(_STIFFNESSES)[np.argmin(errors, axis=1)], errors.min(axis=1)
        ends = [k for k, shift in enumerate(shifts) if shift in (_STIFFNESSES[0], _STIFFNESSES[-1])]
        beyond = np.sign(shifts[ends])[:, None] * np.array(_FARTHER)
        farther = [twin for k, own in zip(ends, beyond, strict=True) for twin in _stiffened([bodies[k]], own)]
        errors = self.errors(farther, lag, windows).reshape(beyond.shape)
        for k, own, found in zip(ends, beyond, errors, strict=True):
            if found.min() < least[k]:
                shifts[k], least[k] = own[np.argmin(found)], found.min()
        return shifts, least

    def errors(self, twins: list[Twin], lag: float, windows: list[int]) -> Array:
        """Mean squared distances of the sightings from each twin's tracks [m^2], summed over windows; or infinite."""
        found = []
        points, seen = self.scene.points[: windows[-1]], self.scene.visible[: windows[-1]]
        for tracks in self.simulations.run([Job(_late(twin, lag), windows[-1]) for twin in twins]):
            if tracks is None:
                found.append(np.inf)
                continue
            squares = np.where(seen, np.sum((tracks - points) ** 2, axis=2), 0.0)
            found.append(sum(float(squares[:end].sum()) / max(int(seen[:end].sum()), 1) for end in windows))
        return np.array(found)


def _late(twin: Twin, lag: float) -> Twin:
    """A twin whose controls come so late [s]."""
    return twin.with_effect(effect("actuation_lag", lag_s=lag)) if lag else twin


def taken_as(mesh: Mesh) -> str:
    """What a report says of a sheet that was traced as a mesh."""
    return f"taken as a mesh that another engine recorded, {mesh}; physworld fit --mesh {mesh.spelled} fits it so"


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
        ground_friction=plate.ground_friction,
        device=plate.device,
    )


def _stiffened(twins: list[Twin], shifts: Iterable[float]) -> list[Twin]:
    """Every twin with each of the shifts, twin by twin."""
    return [_stiffer(twin, float(shift)) for twin in twins for shift in shifts]


def _stiffer(twin: Twin, shift: float) -> Twin:
    known = twin.parameters
    gain = float(np.exp(shift))
    return twin.with_parameters(
        membrane_n_m=gain * known["membrane_n_m"], bending_n_m=gain * known["bending_n_m"]
    )
