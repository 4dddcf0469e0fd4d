"""Two versions side by side: paired gains, intervals, and what differs in how they were made."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from physworld_schemas.base import Lineage, Reference
from physworld_schemas.model import ModelVersion, TrainingConfig
from physworld_storage.comparison import compare_versions
from physworld_storage.errors import Conflict

FRAMES = 40
NOW = datetime(2026, 1, 1, tzinfo=UTC)


def version(number: int, error_m: float, *, seed: int = 0, first: int = 60, **changes: Any) -> ModelVersion:
    """A ready version whose model errs by ``error_m`` on top of a wave that every version of the scene shares."""
    wave = 0.004 * (1.0 + np.sin(np.arange(FRAMES) / 3.0))
    noise = np.random.default_rng(seed).normal(0.0, 2e-5, FRAMES)
    curve = wave + error_m + noise
    table = {
        "track_m": {"static": 0.1, "world_model_finetuned": float(curve.mean())},
        "frames": [first, first + FRAMES],
        "per_frame": {
            "times_s": [float(t) for t in np.arange(first, first + FRAMES) / 30.0],
            "track_m": {"static": [0.1] * FRAMES, "world_model_finetuned": [float(e) for e in curve]},
        },
    }
    made: dict[str, Any] = {
        "name": "beam",
        "version": number,
        "state": "ready",
        "created_at": NOW,
        "scene_id": "scn_1",
        "dataset_id": f"dst_{number}",
        "metrics": {"held_out": table, "steps_per_second": {"world_model": 100.0 * number}},
        "config": TrainingConfig(steps=100 * number),
        "lineage": Lineage(
            inputs=[Reference(kind="dataset", id=f"dst_{number}", digest=f"{number}" * 8)], code_version="1"
        ),
    }
    return ModelVersion(**(made | changes))


def test_a_gain_much_smaller_than_the_spread_over_frames_is_seen_because_it_is_paired() -> None:
    found = compare_versions(version(1, 0.001), version(2, 0.0006, seed=1))
    assert (found.a, found.b, found.same_recording) == (1, 2, True)
    (entry,) = [item for item in found.errors if item.predictor == "world_model_finetuned"]
    assert entry.a is not None and entry.b is not None and entry.gain is not None
    assert entry.a.ci95 is not None and entry.b.ci95 is not None and entry.gain.ci95 is not None
    assert entry.a.ci95[0] < entry.b.value, "the unpaired intervals overlap by far"
    assert entry.gain.value == pytest.approx(0.0004, abs=2e-5)
    assert entry.gain.ci95[0] > 0.0003
    (static,) = [item for item in found.errors if item.predictor == "static"]
    assert static.gain is not None and static.gain.value == 0.0
    assert found.curves_b.times_s == found.curves_a.times_s


def test_what_differs_is_listed_and_what_is_equal_is_not() -> None:
    found = compare_versions(version(1, 0.001), version(2, 0.001))
    differences = {item.field: (item.a, item.b) for item in found.differences}
    assert differences == {
        "config.steps": (100, 200),
        "dataset_id": ("dst_1", "dst_2"),
        "lineage.dataset.digest": ("1" * 8, "2" * 8),
    }
    figures = {item.field: (item.a, item.b) for item in found.figures}
    assert figures["steps_per_second.world_model"] == (100.0, 200.0)
    assert figures["seconds.training"] == (None, None)


@pytest.mark.parametrize("changes", [{"scene_id": "scn_2"}, {"first": 50}], ids=["scene", "frames"])
def test_other_frames_give_no_gain(changes: dict[str, Any]) -> None:
    found = compare_versions(version(1, 0.001), version(2, 0.0006, **changes))
    assert not found.same_recording
    assert all(item.gain is None for item in found.errors)
    assert all(item.a is not None and item.b is not None for item in found.errors)


def test_a_version_without_curves_still_compares() -> None:
    bare = version(2, 0.0, metrics={"held_out": {"track_m": {"twin": 0.01, "static": None}}})
    found = compare_versions(version(1, 0.001), bare)
    by_name = {item.predictor: item for item in found.errors}
    assert by_name["twin"].a is None
    assert by_name["twin"].b is not None and by_name["twin"].b.ci95 is None
    assert by_name["static"].b is None


@pytest.mark.parametrize("state", ["pending", "failed"])
def test_only_ready_versions_are_compared(state: str) -> None:
    with pytest.raises(Conflict, match=f"version 2 of beam is {state}"):
        compare_versions(version(1, 0.001), version(2, 0.001, state=state))
