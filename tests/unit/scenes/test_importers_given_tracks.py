"""Tracks of another tracker beside the pictures: put into space, or refused with numbers where they do not fit."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cameras_pictured as recorded
import numpy as np
import pytest

from benchmarks.tracking.measure import followed_exactly
from physworld_scenes.bundle import read_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.given_tracks import read_tracks
from physworld_scenes.importers.pictures import read_pictures
from physworld_workers.commands import importing

pytestmark = pytest.mark.slow

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracks") / "bar"
    recorded.write(folder)
    return folder


@pytest.fixture(scope="module")
def good(made: Path) -> Arrays:
    return recorded.tracks_of(made, 0)


def imported(folder: Path, out: Path, *options: str) -> int:
    box = ",".join(str(side) for side in json.loads((folder / "truth.json").read_text())["box_px"])
    return importing.main(
        [str(folder), f"--out={out}", f"--box={box}", "--kind=beam", "--points=80", *options]
    )


def read(folder: Path, path: Path) -> list[str]:
    warnings: list[str] = []
    read_tracks(folder, {0: path}, read_pictures(folder), warnings)
    return warnings


def test_the_command_takes_a_file_a_camera_and_follows_the_others_itself(
    made: Path, tmp_path: Path, good: Arrays
) -> None:
    files = []
    for camera in (0, 1):
        tracks = good if camera == 0 else recorded.tracks_of(made, 1)
        # as TAPIR counts pixels
        np.savez(
            tmp_path / f"{camera}.npz",
            **(tracks | {"tracks": tracks["tracks"] + 0.5, "centre": np.array(0.5)}),
        )
        files.append(f"--tracks={camera}:{tmp_path / f'{camera}.npz'}")
    assert imported(made, tmp_path / "scene", *files) == 0
    scene = read_bundle(tmp_path / "scene")
    assert scene.declared["notes"]["tracks_given"] == [0, 1]
    owner = scene.extra_arrays["tracked_by_camera"]
    assert all((owner == camera).sum() >= 8 for camera in range(3))
    with np.load(made / "truth.npz") as truth:
        exact = followed_exactly(truth["vertices"].astype(float), truth["triangles"], scene.points[0])
    miss = 1e3 * np.linalg.norm(scene.points - exact, axis=2)
    seen = scene.visible & (owner < 2)
    assert np.median(miss[seen]) < 0.9 and np.percentile(miss[seen], 95) < 4.0
    # seen where the tracks say so: most of them to the end
    assert scene.visible[-1, owner == 0].sum() > 0.6 * (owner == 0).sum()


def test_files_in_the_folder_tracks_need_no_option(made: Path, tmp_path: Path, good: Arrays) -> None:
    recorded.first_camera(made, tmp_path / "one")
    (tmp_path / "one/tracks").mkdir()
    # shares instead of truths, and one point that jumps to the background
    astray = good["tracks"].copy()
    first = int(np.flatnonzero(good["visible"].all(axis=0))[0])
    astray[8:, first] = [20.0, 20.0]
    np.savez(tmp_path / "one/tracks/0.npz", tracks=astray, visible=good["visible"] * 0.9)
    assert imported(tmp_path / "one", tmp_path / "scene") == 0
    scene = read_bundle(tmp_path / "scene")
    assert scene.declared["notes"]["tracks_given"] == [0]
    with np.load(made / "truth.npz") as truth:
        exact = followed_exactly(truth["vertices"].astype(float), truth["triangles"], scene.points[0])
    miss = 1e3 * np.linalg.norm(scene.points - exact, axis=2)[scene.visible]
    assert np.median(miss) < 0.9 and miss.max() < 40.0
    (tmp_path / "one/tracks/0.npz").rename(tmp_path / "one/tracks/camera.npz")
    with pytest.raises(SceneInvalid, match=r"tracks: holds camera\.npz, not 0\.npz"):
        read_tracks(tmp_path / "one", {}, read_pictures(tmp_path / "one"), [])


def with_(**arrays: object) -> Callable[[Arrays], Arrays]:
    return lambda good: good | {name: make(good) for name, make in arrays.items() if callable(make)}


def nan_at(good: Arrays) -> np.ndarray:
    tracks = good["tracks"].copy()
    frame, point = np.argwhere(good["visible"])[-1]
    tracks[frame, point] = np.nan
    return tracks


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            with_(tracks=lambda g: g["tracks"][None]),
            r"\(1, 16, 120, 2\) and visible \(16, 120\) are not \(T, N, 2\)",
        ),
        (with_(visible=lambda g: g["visible"].T), r"visible \(120, 16\) are not"),
        (
            with_(tracks=lambda g: g["tracks"][:9], visible=lambda g: g["visible"][:9]),
            "9 frames of tracks, 16 of",
        ),
        (
            with_(tracks=lambda g: g["tracks"][:, :1], visible=lambda g: g["visible"][:, :1]),
            "1 points; 4 to 100000",
        ),
        (with_(tracks=lambda g: g["tracks"][:, :0], visible=lambda g: g["visible"][:, :0]), "0 points; 4 to"),
        (with_(tracks=nan_at), "1 visible places are no numbers, the first in frame 15, point"),
        (
            with_(tracks=lambda g: 4.0 * g["tracks"]),
            r"visible places are outside of the picture of 320 x 240 px; they",
        ),
        (with_(tracks=lambda g: g["tracks"] - 1e30), "visible places are outside of the picture"),
        (with_(visible=lambda g: 2.0 * g["visible"]), "numbers outside of 0 to 1, such as 2"),
        (with_(visible=lambda g: np.full(g["visible"].shape, np.nan)), "1920 numbers outside of 0 to 1"),
        (with_(centre=lambda g: np.array(0.25)), r"centre is \[0\.25\]; it is 0 or 0\.5"),
        (with_(centre=lambda g: np.array([0.5, 0.5])), "it is 0 or 0.5"),
        (lambda good: {"tracks": good["tracks"]}, "has no visible; it has tracks"),
        (lambda good: {"points": good["tracks"]}, "has no tracks and no visible; it has points"),
    ],
)
def test_tracks_that_do_not_fit_are_refused_with_numbers(
    made: Path, tmp_path: Path, good: Arrays, spoil: Callable[[Arrays], Arrays], said: str
) -> None:
    np.savez(tmp_path / "tracks.npz", **spoil(good))
    with pytest.raises(SceneInvalid, match=f"tracks of camera 0: .*{said}") as refusal:
        read(made, tmp_path / "tracks.npz")
    assert "\n" not in str(refusal.value)


def test_files_that_are_none_are_refused(made: Path, tmp_path: Path, good: Arrays) -> None:
    path = tmp_path / "tracks.npz"
    with pytest.raises(SceneInvalid, match=r"tracks\.npz is not there"):
        read(made, path)
    path.write_bytes(pickle.dumps(good))
    with pytest.raises(SceneInvalid, match="not an npz"):
        read(made, path)
    np.savez(path, tracks=np.array([{"a": 1}], dtype=object), visible=good["visible"])
    with pytest.raises(SceneInvalid, match="tracks"):
        read(made, path)
    whole = io.BytesIO()
    np.savez(whole, **good)
    path.write_bytes(whole.getvalue()[:-400])
    with pytest.raises(SceneInvalid, match="damaged or truncated"):
        read(made, path)


def test_a_few_places_outside_do_not_count_and_are_said(made: Path, tmp_path: Path, good: Arrays) -> None:
    tracks = good["tracks"].copy()
    frame, point = np.argwhere(good["visible"])[-1]
    tracks[frame, point] = [-3.0, 100.0]
    np.savez(tmp_path / "tracks.npz", tracks=tracks, visible=good["visible"])
    assert read(made, tmp_path / "tracks.npz") == [
        "tracks of camera 0: 1 visible places outside of the picture do not count"
    ]


def test_tracks_beside_the_object_are_refused_with_how_many_there_are(
    made: Path, tmp_path: Path, good: Arrays, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.first_camera(made, tmp_path / "one")
    table = np.tile(
        np.stack(np.meshgrid(np.arange(10) * 4.0 + 250, np.arange(5) * 4.0 + 200), -1).reshape(-1, 2),
        (16, 1, 1),
    )
    np.savez(tmp_path / "tracks.npz", tracks=table, visible=np.ones((16, 50), dtype=bool))
    assert imported(tmp_path / "one", tmp_path / "scene", f"--tracks={tmp_path / 'tracks.npz'}") == 2
    said = capsys.readouterr().err
    assert (
        "0 tracks can be used, 4 are needed: of 50 tracks 50 are seen in the first frame, 0 of them on"
        in said
    )
    assert not (tmp_path / "scene").exists()
