"""The table of spring–mass networks: what is there is not done again, what another run has is taken over."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured import kept, springs
from physworld.baselines import fit_spring_gaus
from physworld.baselines.spring_fit import SpringModel, SpringSettings
from physworld_scenes.bundle import write_bundle
from tests.tiny_scene import tiny_scene

pytestmark = pytest.mark.slow


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> dict[str, object]:
    monkeypatch.setattr("sys.argv", ["springs", *arguments])
    assert springs.main() == 0
    found: dict[str, object] = json.loads(Path(arguments[1]).read_text())["recordings"]
    return found


def test_a_pair_has_its_errors_or_a_reason_and_is_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bundle(replace(tiny_scene(), name="rope_b_shake"), tmp_path / "set" / "rope_b_shake")
    of = ("--set", str(tmp_path / "set"), "--only", "rope_b_shake", "rope_a_ring")
    one, other = str(tmp_path / "one.json"), str(tmp_path / "other.json")
    found = run(monkeypatch, "--json", one, *of, "--predictors", "rigid_follow", "linear_cloth")
    said = capsys.readouterr()
    assert "rope_a_ring: left out" in said.err
    assert "| rope_b_shake | rigid follow |" in said.out and "on no declared grid" in said.out
    predictors = found["rope_b_shake"]["predictors"]  # type: ignore[index]
    assert predictors["rigid_follow"]["reason"] is None and predictors["rigid_follow"]["track_m"] < 1e-4
    assert "SceneUnsupported" in predictors["linear_cloth"]["reason"]

    def refuse(*_: object) -> None:
        raise AssertionError("it was finished")

    monkeypatch.setattr(springs, "measure", refuse)
    taken = run(monkeypatch, "--json", other, *of, "--predictors", "rigid_follow", "--resume", one)
    assert taken == found


def test_a_network_is_fitted_once_for_a_recording(tmp_path: Path) -> None:
    scene, few = tiny_scene(), SpringSettings(points=40, epochs=1)
    begun = []

    def fit(of: object) -> SpringModel:
        begun.append(of)
        return fit_spring_gaus(scene, few)

    first = kept.fitted("spring_gaus", fit, scene, tmp_path)
    again = kept.fitted("spring_gaus", fit, scene, tmp_path)
    np.testing.assert_array_equal(first(scene), again(scene))
    assert len(begun) == 1
    kept.fitted("spring_gaus", fit, replace(scene, points=scene.points + 1e-3), tmp_path)
    assert len(begun) == 2
