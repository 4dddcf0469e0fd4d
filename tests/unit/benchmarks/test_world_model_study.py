"""The study's judges: baselines against motions of known truth, and what a cell is kept under."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.worldmodel import study

OBJECTS, CONTROLS, FRAMES = 7, 4, 30


def rigid_motion_of_all() -> np.ndarray:
    """Object and control vertices that turn and move as one body, at rest in the given frames (T, V, 3)."""
    shape = np.random.default_rng(0).normal(size=(OBJECTS + CONTROLS, 3))
    share = np.maximum(np.arange(FRAMES) - study.GIVEN + 1, 0)[:, None] / FRAMES
    turns = Rotation.from_rotvec(share * [2.0, 1.0, 0.0]).as_matrix()
    return np.einsum("tij,vj->tvi", turns, shape) + 3.0 * share[:, None]


def test_following_the_grips_is_exact_for_a_rigid_body_and_standing_still_is_not() -> None:
    truth = rigid_motion_of_all()
    followed = study.distances([study.following(truth, OBJECTS)], [truth], OBJECTS)
    still = study.distances([study.standing_still(truth, OBJECTS)], [truth], OBJECTS)
    assert followed.shape == (1, FRAMES - study.GIVEN)
    assert followed.max() < 1e-9
    expected = np.linalg.norm(truth[study.GIVEN :, :OBJECTS] - truth[0, :OBJECTS], axis=-1).mean(axis=1)
    assert still[0] == pytest.approx(expected)


def test_what_left_the_numbers_errs_infinitely() -> None:
    truth = rigid_motion_of_all()
    lost = truth.copy()
    lost[20, 0] = np.nan
    errors = study.distances([lost], [truth], OBJECTS)
    assert np.isinf(errors[0, 20 - study.GIVEN]) and np.isfinite(errors[0, 0])


def test_a_cell_made_by_other_code_or_settings_is_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = {study.cell_path(tmp_path, "beam", "grip", 0, budget).name for budget in (60.0, 120.0)}
    places |= {study.cell_path(tmp_path, "beam", name, 0, 60.0).name for name in ("grip", "today")}
    monkeypatch.setattr(study, "code_digest", lambda: "other")
    places.add(study.cell_path(tmp_path, "beam", "grip", 0, 60.0).name)
    assert len(places) == 4
