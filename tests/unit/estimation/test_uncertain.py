"""What controllers err by: it moves numbers as far as intervals say, and a fit that knows of it covers the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from looped_bar import BUDGET, TRUE_PA, shaken_bar

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.estimation.uncertain import mistaken_drives, moved_by
from physworld.scene import Scene

pytestmark = pytest.mark.slow

LARGER = 0.04
"""By so much the stroke of the grip seems larger than it is: the bar then swings less far for it, and seems stiffer."""


def test_numbers_move_as_least_squares_moves_them() -> None:
    rng = np.random.default_rng(0)
    jacobian, modes = rng.normal(size=(60, 2)), rng.normal(size=(5, 60))
    found = [np.linalg.lstsq(jacobian, rng.normal(size=5) @ modes, rcond=None)[0] for _ in range(4000)]
    assert moved_by(jacobian, list(modes)) == pytest.approx(np.cov(np.array(found).T), rel=0.15, abs=0.02)
    assert not moved_by(jacobian, []).any()


def mistaken(known: bool) -> Scene:
    """The shaken bar under a grip that was measured a little too large, whether or not the scene says that it may."""
    scene = shaken_bar()
    error = LARGER * (scene.controllers - scene.controllers[0])
    return replace(
        scene, controllers=scene.controllers + error, controller_errors_m=error[None] if known else None
    )


def test_an_interval_covers_what_controllers_err_by() -> None:
    config = CalibrationConfig(particle_budget=BUDGET)
    blind, knowing = (calibrate(mistaken(known), config).parameters for known in (False, True))
    modulus = "youngs_modulus_pa"
    assert blind[modulus].value == knowing[modulus].value
    narrow, wide = (found[modulus].ci95 for found in (blind, knowing))
    assert narrow is not None and wide is not None
    assert not narrow[0] <= TRUE_PA <= narrow[1]
    assert wide[0] <= TRUE_PA <= wide[1]


def test_errors_are_none_beside_controllers_at_a_higher_rate() -> None:
    scene = mistaken(True)
    assert len(mistaken_drives(scene)) == 1
    faster = replace(scene, control_times=scene.times, control_points=scene.controllers)
    assert not mistaken_drives(faster)
