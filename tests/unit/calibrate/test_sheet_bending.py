"""A sheet that bends otherwise than a homogeneous plate of its thickness: found beside the modulus of its stretch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.parameters import bending_ratio, parameters_of
from physworld.materials.library import with_law
from physworld.materials.sheet import SheetLaw
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SIDE, THICKNESS, HELD, FRAMES = 0.24, 0.005, 0.03, 30
MODULUS_PA, SIGMA_M = 1.8e5, 5e-4


def two_corners() -> Scene:
    """A square sheet that hangs by two corners which swing at paces of their own."""
    places = np.linspace(0.0, SIDE, 9)
    points = [[x, 0.0, z] for x in places for z in places]
    corners = [np.array([x, 0.0, SIDE - HELD]) for x in (0.0, SIDE - HELD)]
    handles = [corner + np.array([x, 0.0, z]) for corner in corners for x in (0.0, HELD) for z in (0.0, HELD)]
    half = np.array([0.0, 0.5 * THICKNESS, 0.0])
    grips = tuple(
        Grip(tuple(range(4 * g, 4 * g + 4)), corner - half, corner + half + np.array([HELD, 0.0, HELD]))
        for g, corner in enumerate(corners)
    )
    body = Body(size_m=np.array([SIDE, THICKNESS, SIDE]), thickness_m=THICKNESS, density_kg_m3=380.0)
    scene = made_scene(
        points, "sheet", handles, FRAMES, initial_state=UNDEFORMED_AT_REST, body=body, grips=grips
    )
    t = scene.times[:, None]
    rise = 1.0 - np.exp(-((t / 0.1) ** 2))
    moves = [rise * np.sin(pace * t) * line for pace, line in
             ((6.0, np.array([0.005, 0.025, 0.01])), (8.0, np.array([-0.005, 0.02, -0.015])))]  # fmt: skip
    shifts = np.repeat(np.stack(moves, axis=1), 4, axis=1)
    return replace(scene, controllers=scene.controllers + shifts)


def plate(scene: Scene) -> Twin:
    membrane = MODULUS_PA * THICKNESS / (1.0 - 0.3**2)
    return build_twin(scene).with_parameters(
        membrane_n_m=membrane, bending_n_m=membrane * THICKNESS**2 / 12.0
    )


@pytest.mark.slow
def test_a_sheet_that_bends_like_hinges_is_found_with_its_modulus() -> None:
    scene = two_corners()
    known = plate(scene)
    known = known.with_parameters(
        bending_n_m=0.6 * known.parameters["bending_n_m"], bending_twist_ratio=2.5, bending_coupling=-0.8
    )
    fitted = calibrate(recorded_by(known, scene, SIGMA_M), CalibrationConfig(damping="none"))
    found = fitted.parameters
    assert found["youngs_modulus_pa"].value == pytest.approx(MODULUS_PA, rel=0.02)
    assert found["bending_ratio"].value == pytest.approx(0.6, rel=0.08)
    assert found["bending_twist_ratio"].value == pytest.approx(2.5, rel=0.08)
    assert found["bending_coupling"].value == pytest.approx(-0.8, abs=0.2)


@pytest.mark.slow
def test_a_homogeneous_plate_is_left_one() -> None:
    """But for its twist, into which the noise of frame 0 goes: it misplaces the points."""
    scene = two_corners()
    fitted = calibrate(recorded_by(plate(scene), scene, SIGMA_M), CalibrationConfig(damping="none"))
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(MODULUS_PA, rel=0.01)
    assert fitted.parameters["bending_twist_ratio"].value == pytest.approx(1.0, abs=0.2)
    for name in ("bending_ratio", "bending_coupling"):
        assert fitted.parameters[name].value == 1.0
        assert "held at its prior" in fitted.parameters[name].note


@pytest.mark.slow
def test_the_weft_of_a_woven_sheet_is_found() -> None:
    scene = two_corners()
    known = plate(scene)
    known = replace(known, law=with_law(known.law, "orthotropic_sheet")).with_parameters(
        bending_weft_ratio=0.4
    )
    config = CalibrationConfig(damping="none", bending="declared", law="orthotropic_sheet")
    found = calibrate(recorded_by(known, scene, SIGMA_M), config).parameters
    assert found["youngs_modulus_pa"].value == pytest.approx(MODULUS_PA, rel=0.05)
    weft = found["bending_weft_ratio"]
    assert weft.identified and weft.value == pytest.approx(0.4, rel=0.1)


def test_what_a_weave_may_change_is_searched_where_the_law_has_it() -> None:
    twin = plate(two_corners())
    woven = replace(twin, law=with_law(twin.law, "orthotropic_sheet"))
    names = [{p.name for p in parameters_of(one, separate_bending=False)} for one in (twin, woven)]
    assert names[1] - names[0] == {"weft_ratio", "shear_ratio", "bending_weft_ratio"}
    for parameter in parameters_of(woven, separate_bending=False):
        if parameter.name not in names[0]:
            assert parameter.held == 1.0 and parameter.apply(woven, 0.5).parameters[parameter.name] == 0.5


def test_changing_the_modulus_keeps_how_a_sheet_bends() -> None:
    twin = plate(two_corners())
    twin = twin.with_parameters(bending_n_m=0.6 * twin.parameters["bending_n_m"])
    modulus = next(p for p in parameters_of(twin, False) if p.name == "youngs_modulus_pa")
    softer = modulus.apply(twin, 1e5)
    assert bending_ratio(softer) == pytest.approx(0.6, rel=1e-12)
    assert isinstance(softer.law, SheetLaw)
