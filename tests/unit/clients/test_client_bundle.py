"""Packing a local scene for the upload."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from physworld_client.bundle import open_bundle
from physworld_client.errors import BundleUnreadable


def make_folder(path: Path, *extra: str) -> Path:
    path.mkdir(parents=True)
    for name in ("scene.json", "scene.npz", *extra):
        (path / name).write_bytes(name.encode())
    return path


def test_a_folder_becomes_a_zip_of_exactly_its_two_files(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "beam", "truth.json")
    with open_bundle(folder) as upload:
        assert upload.filename == "beam.zip"
        with zipfile.ZipFile(upload.stream) as archive:
            assert archive.namelist() == ["scene.json", "scene.npz"]
            assert archive.read("scene.npz") == b"scene.npz"


def test_meshes_of_colliders_travel_along(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "push", "hand.STL")
    (folder / "tools").mkdir()
    (folder / "tools" / "peg.off").write_bytes(b"peg")
    with open_bundle(folder) as upload, zipfile.ZipFile(upload.stream) as archive:
        assert archive.namelist() == ["scene.json", "scene.npz", "hand.STL", "tools/peg.off"]
        assert archive.read("tools/peg.off") == b"peg"


def test_the_same_scene_packs_to_the_same_bytes(tmp_path: Path) -> None:
    first, second = make_folder(tmp_path / "a" / "s"), make_folder(tmp_path / "b" / "s")
    with open_bundle(first) as one, open_bundle(second) as two:
        assert one.stream.read() == two.stream.read()


def test_a_file_is_sent_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "final_data.pkl"
    path.write_bytes(b"pickled")
    with open_bundle(path) as upload:
        assert (upload.filename, upload.stream.read()) == ("final_data.pkl", b"pickled")
    assert upload.stream.closed


def test_a_folder_without_its_files_is_named_with_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "final_data.pkl").write_bytes(b"x")
    with pytest.raises(BundleUnreadable, match=r"lacks scene.json and scene.npz \(it holds final_data.pkl\)"):
        open_bundle(tmp_path)


@pytest.mark.parametrize("name", ["absent", "empty.zip"])
def test_nothing_to_send_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty.zip").touch()
    with pytest.raises(BundleUnreadable, match=name):
        open_bundle(tmp_path / name)


def test_a_folder_of_pictures_is_told_from_a_scene_and_names_its_importer(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    for number in range(3):
        (tmp_path / "color" / f"{number}.png").write_bytes(b"x")
    with pytest.raises(BundleUnreadable, match=r"3 pictures were seen .*`physworld import .* --out SCENE`"):
        open_bundle(tmp_path)
