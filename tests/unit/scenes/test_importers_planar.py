"""Films of known truth to scenes, by the command that people use; what tells no plane, and what leaves it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import planar_filmed as filmed
import pytest
from planar_filmed import BOARD, CLAMP, FPS, FRAMES, HALF_M, LENGTH_M, Film

from physworld.scene import Scene
from physworld_scenes.bundle import read_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import FOLDERS, import_any
from physworld_scenes.importers.film import is_film, read_film
from physworld_workers.commands import importing

pytestmark = pytest.mark.slow

MEDIAN_M, MOST_M = 0.2e-3, 1.0e-3
"""A fifth of a pixel in the middle, one pixel for 95 % of all."""
CLAMP_IN_SCENE = np.array([CLAMP[0], CLAMP[1] - filmed.SQUARES[1] * filmed.SQUARE_M])
"""OpenCV counts a board from its upper left corner, which is the scene's origin."""
CLAMP_BOX = ((0.0, -HALF_M), (0.03, HALF_M))
"""Of material."""


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Film().write(tmp_path_factory.mktemp("film") / "strip.mp4")


def imported(source: Path, out: Path, *options: str, film: Film | None = None) -> Scene:
    box = f"--box={(film or Film()).box()}"
    assert (
        importing.main([str(source), f"--out={out}", box, "--kind=beam", "--thickness=0.01", *options]) == 0
    )
    return read_bundle(out)


def refusal(capsys: pytest.CaptureFixture[str], source: Path, out: Path, *options: str) -> str:
    given = [str(source), f"--out={out}", f"--box={Film().box()}", "--kind=beam", "--thickness=0.01"]
    assert importing.main([*given, *options]) == 2
    assert not out.exists()
    return capsys.readouterr().err


def in_plane(scene: Scene, axes: tuple[int, int] = (0, 2)) -> np.ndarray:
    return scene.points[..., list(axes)]


def truth(scene: Scene) -> np.ndarray:
    """Tracks (T, N, 2) [m] of the material that the first frame, in which the strip is straight, shows."""
    material = in_plane(scene)[0] - CLAMP_IN_SCENE
    return np.stack(
        [filmed.bent(material, filmed.curvature(t)) - CLAMP + CLAMP_IN_SCENE for t in range(FRAMES)]
    )


def require_true(scene: Scene) -> None:
    miss = np.linalg.norm(in_plane(scene) - truth(scene), axis=2)[scene.visible]
    assert np.median(miss) < MEDIAN_M and np.percentile(miss, 95) < MOST_M
    assert scene.visible.mean() > 0.7 and scene.points.shape[1] > 60


def notes(scene: Scene) -> dict:
    return dict(scene.declared["notes"])


@pytest.mark.parametrize("lens_known", [False, True])
def test_a_strip_before_a_board_is_where_it_is(strip: Path, tmp_path: Path, lens_known: bool) -> None:
    lens = [f"--camera={Film().write_lens(tmp_path / 'lens.json')}"] if lens_known else []
    scene = imported(strip, tmp_path / "scene", f"--board={BOARD}", "--up=y", *lens)
    require_true(scene)
    assert scene.fps == FPS and np.allclose(scene.times, np.arange(FRAMES) / FPS, atol=1e-6)
    # on the plane, whose normal is the scene's y; the strip reaches behind it
    assert np.abs(scene.points[scene.visible][:, 1]).max() < 1e-9
    filled = scene.rest_volume_points
    assert filled is not None and filled[:, 1].min() > 0.0 and filled[:, 1].max() < 0.01
    assert np.ptp(filled[:, 0]) == pytest.approx(LENGTH_M, rel=0.05)
    assert "out of the plane is not seen" in scene.declared["description"]
    plane = notes(scene)["plane"]
    assert plane["tilt_deg"] == pytest.approx(20.0, abs=1.0) and plane["residual_px"] < 0.3
    # in the plane the noise is what the tracks show; across it hardly anything is known, so that a fit looks away
    spread = np.std((in_plane(scene) - truth(scene))[scene.visible], axis=0).max()
    noise = notes(scene)["noise_in_plane_m"]
    assert 0.2 * spread < noise < 3.0 * spread
    covariance = scene.noise_covariance_m2
    assert covariance is not None and np.allclose(np.diagonal(covariance[0])[[0, 2]], noise**2, rtol=1e-5)
    weighed = np.abs(scene.weighed(np.tile(np.eye(3)[:, None] * 1e-3, (1, covariance.shape[0], 1))))
    assert weighed[1].max() < 0.1 * weighed[0].max() and weighed[0].max() == pytest.approx(weighed[2].max())


def test_a_curved_lens_is_straightened(tmp_path: Path) -> None:
    film = Film(distortion=-0.25)
    source, lens = film.write(tmp_path / "curved.mp4"), film.write_lens(tmp_path / "lens.json")
    require_true(
        imported(source, tmp_path / "scene", f"--board={BOARD}", "--up=y", f"--camera={lens}", film=film)
    )


def test_a_length_tells_the_scale_of_a_plane_seen_straight_on(tmp_path: Path) -> None:
    film = Film(tilt_deg=0.0)
    ends = film.pixel(np.array([[0.0, 0.0], [0.3, 0.0]])).ravel()
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"{number}.png"), film.frame(number)[..., ::-1])
    scale = ",".join(f"{value:.2f}" for value in ends)
    scene = imported(folder, tmp_path / "scene", f"--scale={scale},0.3", f"--fps={FPS}", "--up=y", film=film)
    first = in_plane(scene)[0] - CLAMP
    exact = np.stack([filmed.bent(first, filmed.curvature(t)) for t in range(FRAMES)])
    miss = np.linalg.norm(in_plane(scene) - exact, axis=2)[scene.visible]
    assert np.median(miss) < 2 * MEDIAN_M and np.percentile(miss, 95) < 2 * MOST_M


def test_a_plumb_line_turns_the_world_and_a_table_lies_level(strip: Path, tmp_path: Path) -> None:
    ends = Film().pixel(np.array([[0.1, 0.2], [0.15, 0.2 - 0.05 * np.sqrt(3)]])).ravel()
    plumb = ",".join(f"{value:.3f}" for value in ends)
    hung = imported(strip, tmp_path / "hung", f"--board={BOARD}", f"--plumb={plumb}")
    along = np.linalg.svd(in_plane(hung)[0] - in_plane(hung)[0].mean(axis=0))[2][0]
    assert np.degrees(np.arctan(along[1] / along[0])) == pytest.approx(-30.0, abs=0.5)
    flat = imported(strip, tmp_path / "flat", f"--board={BOARD}", "--up=z")
    assert np.abs(flat.points[flat.visible][:, 2]).max() < 1e-9
    assert flat.ground is not None and flat.ground.height_m == pytest.approx(-0.01)
    seen = in_plane(flat, (0, 1))[flat.visible]
    assert np.linalg.norm(seen - CLAMP_IN_SCENE, axis=1).max() < 1.1 * LENGTH_M


def test_a_grip_holds_the_strip_where_it_is_clamped(strip: Path, tmp_path: Path) -> None:
    corners = Film().pixel(CLAMP + np.array(CLAMP_BOX))
    low, high = corners.min(axis=0).astype(int), corners.max(axis=0).astype(int)
    held = f"{low[0]},{low[1]},{high[0]},{high[1]}"
    scene = imported(
        strip, tmp_path / "scene", f"--board={BOARD}", "--up=y", f"--patch={held}", f"--held={held}"
    )
    (grip,) = scene.grips
    middle = 0.5 * (grip.region_min_m + grip.region_max_m)
    assert np.allclose(middle[[0, 2]], CLAMP_IN_SCENE + np.array([0.015, 0.0]), atol=2e-3)
    assert grip.region_min_m[1] < 0.0 and grip.region_max_m[1] > 0.01
    # it bends 30 mm of the strip by a millimetre
    assert np.abs(scene.controllers - scene.controllers[0]).max() < 2.5e-3


def test_markers_and_colours_tell_a_gripper_on_the_plane(
    strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = imported(strip, tmp_path / "still", f"--board={BOARD}", "--up=y", "--marker=13")
    assert still.controllers.shape == (FRAMES, 4, 3)
    assert np.linalg.norm(still.controllers[0, 0] - still.controllers[0, 1]) == pytest.approx(
        filmed.MARKER_M, rel=0.02
    )
    assert np.abs(still.controllers - still.controllers[0]).max() < 0.3e-3
    assert "what the gripper holds is not said" in capsys.readouterr().out
    at = Film().pixel(CLAMP + np.array([[0.1, 0.0]]))[0].round().astype(int)
    moving = imported(strip, tmp_path / "moving", f"--board={BOARD}", "--up=y", f"--colour={at[0]},{at[1]}")
    middle = np.stack([filmed.bent(_material(), filmed.curvature(t)).mean(axis=0) for t in range(FRAMES)])
    gone = moving.controllers[:, 0, [0, 2]] - moving.controllers[0, 0, [0, 2]]
    # a path is smoothed over five frames, which is half of this film
    assert np.corrcoef(gone[:, 1], (middle - middle[0])[:, 1])[0, 1] > 0.9


def _material() -> np.ndarray:
    along, across = np.meshgrid(np.linspace(0, LENGTH_M, 50), np.linspace(-HALF_M, HALF_M, 9))
    return np.stack([along.ravel(), across.ravel()], axis=1)


def test_motion_out_of_the_plane_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = Film(tilt_deg=0.0, lean_deg=-40.0)
    scene = imported(
        film.write(tmp_path / "leaning.mp4"), tmp_path / "scene", f"--board={BOARD}", "--up=y", film=film
    )
    said = capsys.readouterr().out
    assert "turned out of the plane by" in said and "which this import does not see" in said
    least = notes(scene)["plane"]["lengths"]["least"]
    assert np.cos(np.radians(40)) - 0.02 < least < 0.9
    upright = Film(tilt_deg=0.0)
    straight = imported(
        upright.write(tmp_path / "in.mp4"), tmp_path / "in", f"--board={BOARD}", "--up=y", film=upright
    )
    lengths = notes(straight)["plane"]["lengths"]
    assert 0.98 < lengths["least"] <= lengths["most"] < 1.02
    assert "does not see" not in capsys.readouterr().out


def test_without_a_plane_or_a_thickness_it_says_what_is_missing(
    strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    assert "--board and --scale" in refusal(capsys, strip, out)
    assert "'charuco:5' is none of" in refusal(capsys, strip, out, "--board=charuco:5")
    given = [str(strip), f"--out={out}", f"--box={Film().box()}", "--kind=beam", f"--board={BOARD}"]
    assert importing.main(given) == 2
    assert "does not see how thick a beam is" in capsys.readouterr().err


def test_a_board_that_is_another_is_not_found(
    strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refusal(capsys, strip, tmp_path / "scene", "--board=aruco:2x2:0.05:0.01:6X6_250")
    assert f"is found in {FRAMES} of {FRAMES} frames" in said and "seen of that dictionary: none" in said


def test_a_scale_that_makes_a_house_of_the_object_is_refused(
    strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    said = refusal(capsys, strip, out, "--scale=100,100,130,100,40")
    assert "40 m between the two pixels makes" in said and "0.001 to 20 m are possible" in said
    assert "between pixels 3.0 px apart" in refusal(capsys, strip, out, "--scale=100,100,103,100,0.1")


def test_one_point_is_no_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "dot"
    folder.mkdir()
    for number in range(4):
        picture = np.full((filmed.HEIGHT, filmed.WIDTH, 3), 120, np.uint8)
        cv2.circle(picture, (150, 170), 5, (40, 60, 220), -1)
        cv2.imwrite(str(folder / f"{number}.png"), picture)
    given = [str(folder), f"--out={tmp_path / 'scene'}", "--box=138,158,162,182", "--kind=rope", "--fps=30"]
    assert importing.main([*given, "--scale=10,10,110,10,0.1", "--up=y"]) == 2
    assert "points of the object can be followed, 4 are needed" in capsys.readouterr().err


def test_a_film_that_was_cut_short_is_read_as_far_as_it_goes_if_that_is_asked_for(
    strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut, content = tmp_path / "cut.mp4", strip.read_bytes()
    cut.write_bytes(content[: int(0.6 * len(content))])
    said = refusal(capsys, cut, tmp_path / "scene", f"--board={BOARD}")
    assert "is cut short" in said and f"of {FRAMES} that it declares" in said
    whole = int(said.split("frames 0:")[1].split()[0])
    assert 4 <= whole < FRAMES
    part = imported(cut, tmp_path / "part", f"--board={BOARD}", "--up=y", f"--frames=0:{whole}")
    assert part.frame_count == whole
    cut.write_bytes(content[:200])
    with pytest.raises(SceneInvalid, match="is no film"):
        read_film(cut)


def test_films_go_backwards_and_lenses_of_other_pictures_are_refused(strip: Path, tmp_path: Path) -> None:
    film = read_film(strip, frames=slice(3, None))
    later, first = film.view.colour(5), film.view.colour(0)
    assert np.array_equal(first, read_film(strip).view.colour(3)) and not np.array_equal(first, later)
    assert np.array_equal(later, film.view.colour(5))
    facts = json.loads(Film().write_lens(tmp_path / "lens.json").read_text())
    (tmp_path / "lens.json").write_text(json.dumps(facts | {"width": 640}))
    with pytest.raises(SceneInvalid, match="640 x 360 pixels, the pictures have 480 x 360"):
        read_film(strip, tmp_path / "lens.json")


def test_the_service_says_who_reads_films(strip: Path, tmp_path: Path) -> None:
    assert [form.name for form in FOLDERS if form.recognises(strip)] == ["film"]
    with pytest.raises(SceneInvalid, match="physworld import"):
        import_any(strip.read_bytes(), "strip.mp4")
    kept = shutil.copytree(Path(__file__).parents[3] / "sample/soft_beam", tmp_path / "kept")
    (kept / "look.png").write_bytes(b"")
    assert not is_film(kept)
