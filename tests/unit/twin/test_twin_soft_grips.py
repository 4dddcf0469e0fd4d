"""A twin whose grip takes hold softly: the same to the last bit at softness 0, and stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.effects.registry import effect
from physworld.engine.terms.soft_grips import AS_HELD, SoftGrips
from physworld.scene import Grip
from physworld.trace.candidates import candidates
from physworld.trace.unknowns import SOFTNESS, grip_softness
from physworld.twin.build import build_twin
from physworld.twin.grips import soft_regions, softly_held
from physworld.twin.twin import Twin

LOW, HIGH = np.array([0.0, -0.03, -0.03]), np.array([0.12, 0.03, 0.03])


def twin_held_by(region_max_m: np.ndarray) -> tuple[Twin, np.ndarray, np.ndarray]:
    """A block that a grip shakes; its box begins at the block's lower corner. With its control track."""
    grip = np.array([[0.0, y, z] for y in (-0.02, 0.0) for z in (-0.02, 0.0)])
    points = [[0.12, y, z] for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
    scene = made_scene(
        points, "block", grip, 8, body=box_body(LOW, HIGH, density_kg_m3=500.0),
        grips=(Grip((0, 1, 2, 3), LOW, region_max_m),),
    )  # fmt: skip
    shake = 0.01 * np.sin(20.0 * scene.times)[:, None, None] * np.array([0.0, 1.0, 0.0])
    return build_twin(scene, 256).with_parameters(youngs_modulus_pa=3e4), scene.times, grip + shake


CORNER, WHOLE = np.array([0.03, 0.0, 0.0]), np.array([0.03, 0.03, 0.03])


def test_at_softness_zero_the_declared_box_changes_no_bit() -> None:
    twin, times, controls = twin_held_by(CORNER)
    plain = replace(twin, grip_regions=())
    assert soft_regions(twin) == []
    same = [t.simulate_nodes(times, controls, times) for t in (twin, plain)]
    assert np.array_equal(*same)


def test_a_soft_grip_gives_and_survives_being_stored() -> None:
    twin, times, controls = twin_held_by(CORNER)
    soft = replace(twin, grip_softness=1 / 10)
    found = soft.simulate_nodes(times, controls, times)
    again = Twin.from_arrays(soft.to_arrays()).simulate_nodes(times, controls, times)
    assert np.array_equal(found, again)
    firm = twin.simulate_nodes(times, controls, times)
    assert np.abs(found - firm).max() > 2e-3
    middle = twin.lattice.interpolation(np.array([[0.015, -0.015, -0.015]]))
    shift = (controls - controls[0]).mean(axis=1)
    gap = np.stack([(middle @ (now - found[0]))[0] for now in found]) - shift
    assert np.abs(gap).max() < 1e-3  # of a shake by 10 mm


@pytest.mark.parametrize("strain", [0.15, -0.15])
def test_a_soft_grip_holds_the_same_material_of_another_rest_shape(strain: float) -> None:
    twin, times, controls = twin_held_by(CORNER)
    held = []
    for one in (twin, twin.with_effect(effect("rest_shape", strain_x=strain))):
        problem = replace(one, grip_softness=1 / 10).integration(times, controls, times).problem
        (grips,) = [term for term in problem.terms if isinstance(term, SoftGrips)]
        held.append((grips.held.nodes, grips.stiffness / grips.stiffness.max()))
    np.testing.assert_array_equal(held[0][0], held[1][0])
    np.testing.assert_allclose(held[0][1], held[1][1], atol=1e-12)


def test_only_a_grip_that_holds_a_part_of_a_section_holds_softly_and_has_its_softness_calibrated() -> None:
    corner, whole = twin_held_by(CORNER)[0], twin_held_by(WHOLE)[0]
    assert softly_held(whole) is whole and grip_softness(whole) is None
    soft = softly_held(corner)
    assert soft.grip_softness == AS_HELD and softly_held(soft) is soft
    unknown = grip_softness(soft)
    assert unknown is not None and unknown.name == SOFTNESS
    assert unknown.start == pytest.approx(np.log(AS_HELD))
    assert unknown.at(corner, np.log(0.05)).grip_softness == pytest.approx(0.05)
    assert "reach_m" not in {gate.name for c in candidates(soft)[0] for gate in c.gates}
    assert "reach_m" in {gate.name for c in candidates(whole)[0] for gate in c.gates}
    assert "0.16 cells" in candidates(soft, ("grip_slip",))[1]["grip_slip"]
