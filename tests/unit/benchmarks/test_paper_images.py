"""The image columns: recordings of known truth, films of predictions, cells that are kept, unseen motions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scene import made_scene

from benchmarks.paper import images, interactions, kept, predictions
from benchmarks.paper.kept import Kept
from benchmarks.paper.motions import WAYS, motions
from benchmarks.paper.pictures import Filmed
from benchmarks.paper.predictions import Settings
from benchmarks.paper.recordings import Recording, judged, record
from physworld.calibrate import CalibrationConfig
from physworld.camera import look_at
from physworld.video import Renderer, SplatConfig, SplatView, eight_bit, gaussians_at_points
from physworld_scenes.bundle import checked

pytestmark = pytest.mark.slow

FRAMES = 12
SETTINGS = Settings(
    frames=FRAMES,
    held_out_every=2,
    training_every=4,
    fit=CalibrationConfig(particle_budget=60, max_simulations=2),
    splat=SplatConfig(steps=2, most=150),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cells")


def moving_plate() -> Filmed:
    """A plate of points that goes up, filmed by the renderer itself; a bar hides its left in the last frame."""
    grid = np.linspace(-0.1, 0.1, 12)
    points = np.stack(np.meshgrid(grid, [0.0], grid, indexing="ij"), axis=-1).reshape(-1, 3)
    scene = made_scene(points, "sheet", frames=3)
    scene = replace(scene, points=points + np.arange(3)[:, None, None] * np.array([0.0, 0.0, 0.05]))
    camera = look_at(np.array([0.0, -0.8, 0.0]), np.zeros(3), width=64, height=48)
    splat = gaussians_at_points(points)
    shown = [Renderer(camera).render(replace(splat, means=one)) for one in scene.points]
    seen = np.stack([np.where(one.alpha >= 0.5, 0, -1) for one in shown]).astype(np.int8)
    seen[2, :, :30] = 1
    pictures = np.stack([eight_bit(one) for one in shown])
    view = SplatView(camera, pictures[0], seen[0] == 0)
    return Filmed(Recording(scene, (view,), np.arange(3), pictures, seen), splat)


def test_the_true_motion_has_the_best_film_and_what_is_hidden_does_not_count() -> None:
    filmed = moving_plate()
    points = filmed.recording.scene.points
    true = filmed.compared(points, [1, 2], lambda one, other: float(np.abs(one - other).mean()))
    still = filmed.compared(np.repeat(points[:1], 3, axis=0), [1, 2], lambda one, other: 7.0)
    assert true["iou"] == pytest.approx(1.0) and still["iou"] < 0.9  # type: ignore[operator]
    assert true["psnr_db"] > still["psnr_db"] + 10.0  # type: ignore[operator]
    assert true["ssim"] > still["ssim"]  # type: ignore[operator]
    assert still["lpips"] == 7.0 and filmed.compared(points, [1])["lpips"] is None
    spoilt = points.copy()
    spoilt[2, points[2, :, 0] < -0.03] += [-0.02, 0.0, 0.0]  # behind the bar
    assert filmed.compared(spoilt, [2])["iou"] == pytest.approx(1.0, abs=0.02)
    with pytest.raises(KeyError, match="frame 7 has no picture"):
        filmed.compared(np.repeat(points[:1], 9, axis=0), [7])


def test_held_out_frames_are_none_of_the_training() -> None:
    training, held_out = judged(60, 3, 9)
    assert min(training) > 0 and max(training) == 41 < min(held_out) and max(held_out) == 59
    assert len(held_out) == 6 and len(training) == 5


def test_a_recording_is_the_truth_of_what_its_camera_sees() -> None:
    found = record("rope", 3, [2])
    scene = found.scene
    checked(scene)
    assert found.frames.tolist() == [0, 2] and len(found.views) == 3
    assert found.pictures.shape == (2, 240, 320, 3)
    pixels, _ = found.camera.project(scene.points[2])
    rows, columns = np.floor(pixels[:, 1]).astype(int), np.floor(pixels[:, 0]).astype(int)
    assert (found.seen[1][rows, columns] >= 0).mean() > 0.8, "the points lie on what is seen"
    distances = np.linalg.norm(scene.controllers[:, :1] - scene.controllers, axis=2)
    np.testing.assert_allclose(distances, np.repeat(distances[:1], 3, axis=0), atol=1e-9)
    held = np.array(scene.grips[0].points)
    np.testing.assert_allclose(
        scene.points[2, held] - scene.points[0, held],
        np.tile(scene.controllers[2, 0] - scene.controllers[0, 0], (len(held), 1)),
        atol=2e-3,
    )


def test_a_cut_off_run_goes_on_and_other_settings_are_other_cells(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = folder / "images.json"
    document = images.measured(target, Kept(folder, SETTINGS), ["rope"], ["baselines"], None)
    found = document["recordings"]["rope"]["predictors"]
    assert set(found) == {"truth", "static", "rigid_follow", "twin"}
    assert found["truth"]["track_m"] == 0.0 < found["twin"]["track_m"] < found["static"]["track_m"]
    assert found["truth"]["held_out"]["iou"] > found["static"]["held_out"]["iou"]
    assert found["truth"]["held_out"]["lpips"] is None
    assert json.loads(target.read_text())["recordings"] == document["recordings"]

    def refused(*given: object) -> None:
        raise AssertionError("this was done already")

    for module, name in ((kept, "done"), (kept, "record"), (kept, "twin_of"), (kept, "splat_of")):
        monkeypatch.setattr(module, name, refused)
    again = Kept(folder, SETTINGS)
    assert (
        images.measured(target, again, ["rope"], ["baselines"], None)["recordings"] == document["recordings"]
    )
    target.unlink()
    restored = images.measured(target, again, ["rope"], ["baselines"], None)
    assert restored["recordings"]["rope"]["predictors"]["truth"] == found["truth"]
    assert again.has("rope", "baselines") and not again.has("rope", "full")
    other = Kept(folder, replace(SETTINGS, episodes=3))
    assert other.key() != again.key() and not other.has("rope", "baselines")


def test_a_report_names_what_was_not_run_and_what_failed(folder: Path) -> None:
    document = json.loads((folder / "images.json").read_text())
    document["recordings"]["rope"]["works"]["phystwin"] = {"reason": "no network could be simulated"}
    text = images.report(document).markdown()
    assert "| rope | true motion | 0 |" in text
    assert "Failed: rope phystwin (no network could be simulated)." in text
    assert "rope full" in text and "rope baselines" not in text.split("Not run:")[1]


def test_digests_follow_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "REPOSITORY", tmp_path)
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "one.py").write_text("a = 1\n")
    kept.sources.cache_clear()
    before = kept.sources(("room",))
    (tmp_path / "room" / "one.py").write_text("a = 2\n")
    kept.sources.cache_clear()
    assert kept.sources(("room",)) != before
    kept.sources.cache_clear()


def test_what_fails_or_leaves_the_numbers_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = made_scene(np.zeros((4, 3)), "beam")
    lost = np.full(scene.points.shape, np.nan)
    monkeypatch.setitem(predictions.PLAN, "phystwin", lambda *given: ({"a": lost, "b": scene.points}, {}))
    tracks, facts = predictions.done("phystwin", scene, None, SETTINGS)  # type: ignore[arg-type]
    assert list(tracks) == ["b"] and facts["reason"] == "a left the numbers"

    def fails(*given: object) -> None:
        raise ValueError("no such body")

    monkeypatch.setitem(predictions.PLAN, "phystwin", fails)
    nothing, facts = predictions.done("phystwin", scene, None, SETTINGS)  # type: ignore[arg-type]
    assert nothing == {} and "no such body" in facts["reason"]


def test_unseen_motions_begin_at_the_first_frame_at_rest_and_are_rigid() -> None:
    corners = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02]], dtype=float)
    scene = made_scene([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], "beam", corners, frames=60)
    found = motions(scene)
    assert set(found) == set(WAYS) and len(found) == 5
    for one in found.values():
        np.testing.assert_allclose(one.controllers[0], corners, atol=1e-12)
        assert np.abs(one.controllers[1] - corners).max() < 1e-3
        assert np.abs(one.controllers - corners).max() > 5e-3
        apart = np.linalg.norm(one.controllers[:, 1:] - one.controllers[:, :1], axis=2)
        np.testing.assert_allclose(apart, np.repeat(apart[:1], 60, axis=0), atol=1e-9)
    assert np.ptp(found["stop"].controllers[-31:], axis=0).max() == 0.0


def test_figures_without_a_reference_see_what_is_not_physical() -> None:
    times = np.arange(60) / 30.0
    points = np.stack([np.linspace(0.0, 0.3, 5), np.zeros(5), np.zeros(5)], axis=1)
    swing = np.sin(40.0 * times)[:, None, None] * np.array([0.0, 0.0, 0.01])
    fading, growing = (points + np.exp(rate * times)[:, None, None] * swing for rate in (-2.0, 2.0))
    assert interactions.unrest(fading, times) < 0.5 and interactions.unrest(growing, times) > 2.0
    assert interactions.unrest(np.repeat(points[None], 60, axis=0), times) == 0.0
    edges = interactions.edges_of(points)
    assert interactions.stretches(points + swing, edges).max() == pytest.approx(0.0, abs=1e-9)
    torn = np.repeat(points[None], 60, axis=0)
    torn[30:, -1, 0] += 0.075
    assert interactions.stretches(torn, edges).max() == pytest.approx(1.0)


def test_a_film_that_trembles_flickers_more() -> None:
    filmed = moving_plate()
    times = np.arange(31) / 30.0
    calm = filmed.recording.scene.points[0] + np.linspace(0.0, 0.02, 31)[:, None, None] * [0.0, 0.0, 1.0]
    trembling = calm + np.where(np.arange(31) % 4 < 2, 4e-3, -4e-3)[:, None, None] * [1.0, 0.0, 0.0]
    assert interactions.flicker(filmed, trembling, times) > 2.0 * interactions.flicker(filmed, calm, times)
