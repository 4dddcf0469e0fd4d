"""The torsion of a rope that two hands turn and bring together: found beside its bending stiffness."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import made_scene, recorded_by
from scipy.spatial.transform import Rotation

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LENGTH, ARM, FRAMES = 0.4, 0.02, 40
BENDING_N_M2, TORSION = 2e-3, 0.4


def two_hands() -> Scene:
    """Hands of four points each; the second turns by 0.9 of a turn and comes nearer by a third of the length."""
    cross = ARM * np.array([[0, 1.0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    s = np.linspace(0, LENGTH, 9)
    scene = made_scene(np.stack([s, 0 * s, 0 * s], axis=1), "rope", np.zeros((8, 3)), FRAMES,
                       initial_state=UNDEFORMED_AT_REST, body=Body(length_m=LENGTH, radius_m=0.004))  # fmt: skip
    share = scene.times / scene.times[-1]
    spin = Rotation.from_rotvec(1.8 * np.pi * share[:, None] * np.array([1.0, 0, 0])).as_matrix()
    last = np.einsum("tij,kj->tki", spin, cross)
    last[..., 0] += LENGTH - 0.12 * np.sin(0.5 * np.pi * np.minimum(scene.times / 0.8, 1))[:, None] ** 2
    first = np.repeat(cross[None], FRAMES, axis=0)
    return Scene(**{**vars(scene), "controllers": np.concatenate([first, last], axis=1)})


def test_bending_and_torsion_are_found_apart() -> None:
    scene = two_hands()
    truth = build_twin(scene).with_parameters(bending_n_m2=BENDING_N_M2, torsion_ratio=TORSION)
    found = calibrate(recorded_by(truth, scene, 2e-4), CalibrationConfig(max_simulations=120)).parameters
    for name, value in (("bending_n_m2", BENDING_N_M2), ("torsion_ratio", TORSION)):
        low, high = found[name].ci95
        assert found[name].identified
        assert found[name].value == pytest.approx(value, rel=0.02)
        assert low < value < high
