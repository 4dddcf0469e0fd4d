"""Measured recordings: no failure ends the run, every predictor has a key, a finished part is not redone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured import __main__ as benchmark
from benchmarks.measured import recording, scoring
from benchmarks.measured.page import report
from physworld.evaluate.baselines import BASELINES
from physworld.scene import AS_MEASURED
from physworld_scenes.bundle import canonical_archive
from tests.tiny_scene import tiny_scene


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    """A bar, the same bar anew, and a file that is no recording."""
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "bar.zip").write_bytes(canonical_archive(tiny_scene()))
    (folder / "again.zip").write_bytes(canonical_archive(replace(tiny_scene(16), name="again")))
    (folder / "broken.zip").write_bytes(b"no archive")
    return folder


def test_every_recording_has_every_predictor_or_a_reason(recordings: Path, tmp_path: Path) -> None:
    target = tmp_path / "measured.json"
    few = ["--simulations", "4", "--particles", "60"]
    arguments = ["--set", str(recordings), "--json", str(target), "--transfer", "bar:again,broken", *few]
    assert benchmark.main(arguments) == 0
    document = json.loads(target.read_text())
    assert set(document["recordings"]) == {"bar", "again", "broken"}
    assert "scene" in document["recordings"]["broken"]["reason"]
    bar = document["recordings"]["bar"]
    assert set(bar["track_m"]) == {"twin", *scoring.fits()}
    for name, value in bar["track_m"].items():
        assert (value is None) == (name in bar["reason"])
    assert bar["horizons"]["open_loop"]["whole"]["frames"] == 11
    assert "solid" in bar["horizons"]["restarted"]["reason"]
    assert set(document["transfers"]) == {"bar->again"}
    assert document["transfers"]["bar->again"]["track_m"]["twin"] is not None
    assert "| bar | beam |" in report(document).markdown()

    def refuse(*_: object) -> None:
        raise AssertionError("it was finished")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "measure", refuse)
        assert benchmark.main([*arguments, "--resume", str(target)]) == 0
    assert json.loads(target.read_text())["recordings"]["bar"] == bar


def test_a_predictor_that_fails_has_a_reason_and_the_rest_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()

    def fails(_: object) -> np.ndarray:
        raise ValueError("2 links, 3 needed")

    monkeypatch.setattr(scoring, "BASELINES", {"fails": fails, "static": BASELINES["static"]})
    monkeypatch.setattr(scoring, "PEERS", {})
    models, unfit = scoring.fit_all(scene)
    tracks, reasons = scoring.predict(scene, models)
    assert tracks["fails"] is None and tracks["static"] is not None
    assert {**unfit, **reasons} == {"fails": "ValueError: 2 links, 3 needed"}
    assert scoring.held_out(scene, tracks)["track_m"]["fails"] is None


def test_a_prediction_that_is_not_finite_has_no_score() -> None:
    scene = tiny_scene()
    tracks, reason = scoring.attempt(lambda: np.full(scene.points.shape, np.nan), scene)
    assert tracks is None and reason is not None and "not finite in 12 frames" in reason


def test_a_cut_recording_is_what_was_measured_later_on_a_clock_of_its_own() -> None:
    scene = tiny_scene()
    later = scoring.cut(scene, 5)
    assert np.array_equal(later.points, scene.points[5:])
    assert later.times[0] == 0.0 and np.allclose(np.diff(later.times), np.diff(scene.times[5:]))
    assert later.initial_state == AS_MEASURED and later.train == later.test == (0, 7)


def test_a_horizon_counts_the_frames_that_were_fitted_to() -> None:
    scene = tiny_scene(60)
    shifted = scene.points + np.array([0.0, 0.0, 2e-3])
    found = scoring.against_horizon(scene, {"twin": shifted, "none": None})
    assert list(found) == ["0.5", "1", scoring.WHOLE]
    assert found["0.5"]["frames"] == found["0.5"]["fitted_frames"] == 15
    assert found[scoring.WHOLE]["frames"] == 59 and found[scoring.WHOLE]["fitted_frames"] == 41
    assert found[scoring.WHOLE]["track_m"]["twin"] == pytest.approx(2e-3)
    assert found[scoring.WHOLE]["track_m"]["none"] is None


def test_published_figures_name_their_source_and_a_missing_one_its_reason() -> None:
    entries = json.loads(recording.PUBLISHED.read_text())["entries"]
    for entry in entries:
        assert entry["source"] and entry["citation"] and entry["unit"] and entry["metric"]
        assert entry["value"] is not None or entry["reason"]
    scene = replace(tiny_scene(), declared={"notes": {"source": {"repository": entries[0]["source"]}}})
    assert recording.published(scene) == [entries[0]]


def test_pairs_are_read_and_another_form_is_refused() -> None:
    assert benchmark.pairs_of(["a:b,c", "a:d"]) == {"a": ["b", "c", "d"]}
    with pytest.raises(ValueError, match="A:B,C"):
        benchmark.pairs_of(["a"])


def test_a_set_that_is_absent_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--set", str(tmp_path / "none"), "--json", str(tmp_path / "m.json")]) == 2
    assert "there are no recordings" in capsys.readouterr().err
