"""The quality gate: which figures of a version are a failure, and which are not."""

from __future__ import annotations

from typing import Any

import pytest

from physworld_schemas.model import ModelVersion
from physworld_schemas.quality import quality_of


def figures(model: float | None, static: float = 0.1, rigid: float = 0.014, **more: Any) -> dict[str, Any]:
    """Metrics of a version whose held-out errors these are [m]."""
    errors = {"static": static, "rigid_follow": rigid, "twin": 0.002, "world_model_finetuned": model}
    return {"held_out": {"track_m": errors, "noise_floor_m": 0.0016}} | more


def still(*quarters: float | None, peak: float = 1.0) -> dict[str, Any]:
    """The section on energy."""
    return {"energy": {"still_quarters_m2_s2": list(quarters), "moving_peak_m2_s2": peak}}


def test_a_model_below_both_baselines_passes() -> None:
    found = quality_of(figures(0.004) | still(0.5, 0.2, 0.1, 0.05))
    assert (found.verdict, found.reasons) == ("passed", [])
    assert (found.model_m, found.baselines_m["rigid_follow"]) == (0.004, 0.014)
    assert found.energy_growth == pytest.approx(0.1)


def test_a_diverged_model_fails_with_its_numbers() -> None:
    found = quality_of(figures(0.752))
    assert found.verdict == "failed"
    assert [reason.count("752 mm") for reason in found.reasons] == [1, 1]
    assert "standing still 100 mm" in found.reasons[0]
    assert "following the grips rigidly 14 mm" in found.reasons[1]


def test_worse_than_one_baseline_is_enough() -> None:
    (reason,) = quality_of(figures(0.05)).reasons
    assert "rigidly" in reason


def test_a_rollout_that_left_the_numbers_fails() -> None:
    (reason,) = quality_of(figures(None)).reasons
    assert "left the numbers" in reason


def test_below_the_noise_a_baseline_is_no_limit() -> None:
    assert quality_of(figures(0.0015, rigid=0.0012)).verdict == "passed"
    assert quality_of(figures(0.0017, rigid=0.0012)).verdict == "failed"


def test_energy_that_grows_under_still_grips_fails() -> None:
    (reason,) = quality_of(figures(0.004) | still(0.1, 0.3, 0.9, 2.7)).reasons
    assert "2.7 m²/s²" in reason
    (reason,) = quality_of(figures(0.004) | still(0.1, 0.3, 0.9, None)).reasons
    assert "left the numbers while" in reason


@pytest.mark.parametrize(
    "quarters", [(0.1, 0.3, 0.9, 0.4), (0.1, 0.11, 0.12, 0.13), (1e-9, 1e-8, 1e-7, 1e-6)]
)
def test_a_swing_that_beats_keeps_its_energy_or_hardly_moves_passes(quarters: tuple[float, ...]) -> None:
    assert quality_of(figures(0.004) | still(*quarters)).verdict == "passed"


@pytest.mark.parametrize("metrics", [{}, {"held_out": {}}, {"held_out": {"track_m": {"twin": 1.0}}}])
def test_without_figures_nothing_is_known(metrics: dict[str, Any]) -> None:
    assert quality_of(metrics).verdict == "unknown"


def test_clouds_without_correspondences_are_judged_by_their_distance() -> None:
    errors = {"static": 0.1, "rigid_follow": 0.02, "world_model": 0.3}
    empty = dict.fromkeys(errors)
    found = quality_of({"held_out": {"track_m": empty, "chamfer_l2_m": errors}})
    assert (found.verdict, found.metric) == ("failed", "chamfer_l2_m")


def test_a_version_says_its_quality_on_the_wire() -> None:
    version = ModelVersion.model_validate(
        {"name": "beam", "version": 1, "state": "ready", "created_at": "2026-11-25T00:00:00Z"}
        | {"metrics": figures(0.752)}
    )
    sent = version.model_dump(mode="json")
    assert sent["quality"]["verdict"] == "failed"
    assert ModelVersion.model_validate(sent).quality == version.quality
