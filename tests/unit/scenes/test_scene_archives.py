"""Archives that are hostile or damaged are refused with a reason, and nothing else happens."""

from __future__ import annotations

import io
import stat
import struct
import tarfile
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_parts import sound_parts
from test_scene_bundle import files_of, tar_of

from physworld_scenes.archive_writing import write_arrays, write_zip
from physworld_scenes.archives import (
    ArchiveLimits,
    ArchiveRefused,
    read_archive,
    read_arrays,
    single_folder,
)
from physworld_scenes.bundle import bundle_from_bytes, read_bundle
from physworld_scenes.errors import SceneInvalid

WANTED = frozenset({"scene.json", "scene.npz"})
SMALL = ArchiveLimits(total_bytes=50_000, members=5, ratio=20.0, ratio_free_bytes=1_000)


def zip_with(name: str, content: bytes = b"x", mode: int = 0, compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of one member of that Unix mode."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entry = zipfile.ZipInfo(name)
        entry.external_attr = mode << 16
        entry.compress_type = compression
        archive.writestr(entry, content)
    return buffer.getvalue()


def tar_with(entry: tarfile.TarInfo, content: bytes = b"") -> bytes:
    """A tar of one member."""
    buffer = io.BytesIO()
    entry.size = len(content)
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../scene.json", "climbs out"),
        ("a/../../scene.json", "climbs out"),
        ("/etc/scene.json", "absolute"),
        ("C:/scene.json", "absolute"),
        ("a\\..\\scene.json", "backslash"),
        ("../unrelated.txt", "climbs out"),
    ],
)
def test_a_member_that_leaves_the_archive_is_refused(name: str, reason: str) -> None:
    for archive in (zip_with(name), tar_with(tarfile.TarInfo(name), b"x")):
        with pytest.raises(ArchiveRefused, match=reason):
            read_archive(archive, WANTED)
        with pytest.raises(SceneInvalid, match=reason):
            bundle_from_bytes(archive)


@pytest.mark.parametrize("form", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_a_member_whose_name_is_no_utf8_is_refused_in_words_that_can_be_sent(form: int) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form, encoding="utf-8") as archive:
        archive.addfile(tarfile.TarInfo("caf\udce9/scene.json"))
    with pytest.raises(ArchiveRefused, match="is not UTF-8") as caught:
        read_archive(buffer.getvalue(), WANTED)
    assert str(caught.value).isascii()


@pytest.mark.parametrize(
    "kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE]
)
def test_links_and_devices_in_a_tar_are_refused(kind: bytes) -> None:
    entry = tarfile.TarInfo("scene.json")
    entry.type, entry.linkname = kind, "/etc/passwd"
    with pytest.raises(ArchiveRefused, match="link, a device"):
        read_archive(tar_with(entry), WANTED)


def test_a_link_in_a_zip_is_refused() -> None:
    with pytest.raises(ArchiveRefused, match="link or a device"):
        read_archive(zip_with("scene.json", b"/etc/passwd", stat.S_IFLNK | 0o777), WANTED)


def test_an_encrypted_member_is_refused() -> None:
    data = bytearray(zip_with("scene.json"))
    at = data.index(b"PK\x01\x02")
    data[at + 8] |= 1
    with pytest.raises(ArchiveRefused, match="encrypted"):
        read_archive(bytes(data), WANTED)


def test_two_members_of_one_name_are_refused() -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name in ("scene.json", "./scene.json"):
            archive.addfile(tarfile.TarInfo(name))
    with pytest.raises(ArchiveRefused, match="two members"):
        read_archive(buffer.getvalue(), WANTED)


def test_only_deflate_is_inflated() -> None:
    with pytest.raises(ArchiveRefused, match="compression method"):
        read_archive(zip_with("scene.json", b"x" * 100, compression=zipfile.ZIP_BZIP2), WANTED)


def test_too_many_members_are_refused() -> None:
    files = {f"{i}.txt": b"" for i in range(6)}
    for archive in (write_zip(files), tar_of(files, "w")):
        with pytest.raises(ArchiveRefused, match="5"):
            read_archive(archive, WANTED, SMALL)


@pytest.mark.parametrize("name", ["scene.npz", "unrelated.bin"])
def test_bombs_are_refused_by_size_and_by_ratio(name: str) -> None:
    dense = np.random.default_rng(0).bytes(60_000)
    for content, reason in ((dense, "at most 50000"), (bytes(30_000), "times")):
        for archive in (
            zip_with(name, content, compression=zipfile.ZIP_DEFLATED),
            tar_of({name: content}, "w:gz"),
        ):
            with pytest.raises(ArchiveRefused, match=reason):
                read_archive(archive, WANTED, SMALL)


def test_a_member_larger_than_it_declares_is_refused() -> None:
    data = bytearray(zip_with("scene.json", bytes(4000), compression=zipfile.ZIP_DEFLATED))
    for mark, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        struct.pack_into("<I", data, data.index(mark) + offset, 10)
    with pytest.raises(ArchiveRefused):
        read_archive(bytes(data), WANTED)


def test_a_tar_that_declares_a_negative_size_ends() -> None:
    data = bytearray(tar_with(tarfile.TarInfo("scene.json"), b"abc"))
    data[124:136] = b"\xff" * 11 + b"\x00"
    with pytest.raises(ArchiveRefused):
        read_archive(bytes(data), WANTED)


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_bundle_is_named(part: float) -> None:
    files = files_of(*sound_parts())
    for archive in (write_zip(files), tar_of(files, "w:gz"), tar_of(files, "w")[:-10_240]):
        with pytest.raises(SceneInvalid) as caught:
            bundle_from_bytes(archive[: int(part * len(archive))])
        assert caught.value.faults
    short = files | {"scene.npz": files["scene.npz"][: int(part * len(files["scene.npz"]))]}
    with pytest.raises(SceneInvalid, match=r"scene\.npz"):
        bundle_from_bytes(write_zip(short))


@pytest.mark.parametrize(
    "data", [b"", b"x", b"PK\x03\x04", b"\x1f\x8b", b"\x1f\x8b\x08" + bytes(50), bytes(1024)]
)
def test_what_is_no_archive_is_named(data: bytes) -> None:
    with pytest.raises(ArchiveRefused):
        read_archive(data, WANTED)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_archives_raise_nothing_else(data: st.DataObject) -> None:
    files = {"scene.json": b'{"a": 1}', "scene.npz": write_arrays({"a": np.arange(3.0)})}
    kind = data.draw(st.sampled_from(["zip", "w", "w:gz"]))
    archive = bytearray(write_zip(files) if kind == "zip" else tar_of(files, kind))
    for _ in range(data.draw(st.integers(1, 5))):
        archive[data.draw(st.integers(4, len(archive) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ArchiveRefused):
        for name, content in read_archive(bytes(archive), WANTED).items():
            if name.endswith("npz"):
                read_arrays(content)
    with suppress(SceneInvalid):
        bundle_from_bytes(bytes(archive))


def npy(header: str, content: bytes = b"") -> bytes:
    """An npy file with that header text."""
    text = header.encode().ljust(118 - 1) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


@pytest.mark.parametrize(
    ("member", "reason"),
    [
        (
            npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}", bytes(8)),
            "claims shape",
        ),
        (
            npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"cos\nsystem\n"),
            "never Python objects",
        ),
        (npy("{'descr': '<U4', 'fortran_order': False, 'shape': (1,)}", bytes(16)), "plain numbers"),
        (npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}", bytes(4)), "plain numbers"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}", bytes(8)), "shape"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1 if"), "not an npy"),
        (npy("{'descr': '<f8', 'fortran_order': False}"), "not an npy"),
        (npy("__import__('os').system('true')"), "not an npy"),
        (b"\x93NUMPY\x03\x00" + bytes(50), "version 3"),
        (b"", "not an npy"),
        (b"hello", "not an npy"),
    ],
)
def test_forged_arrays_are_refused(member: bytes, reason: str) -> None:
    with pytest.raises(ArchiveRefused, match=reason):
        read_arrays(write_zip({"points.npy": member}))


def test_arrays_come_back_as_they_were() -> None:
    arrays = {
        "a": np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4))),
        "b": np.arange(6, dtype=np.int16).reshape(2, 3),
        "c": np.array([True, False]),
        "d": np.zeros((0, 3), np.float32),
    }
    read = read_arrays(write_arrays(arrays))
    assert set(read) == set(arrays)
    for name, array in arrays.items():
        assert read[name].dtype == array.dtype
        assert np.array_equal(read[name], array)
        assert read[name].flags.writeable
    buffer = io.BytesIO(write_arrays(arrays))
    with np.load(buffer, allow_pickle=False) as peer:
        assert all(np.array_equal(peer[name], array) for name, array in arrays.items())


def test_the_bundle_lies_at_the_top_or_in_one_folder() -> None:
    assert single_folder(["scene.json"], "scene.json") == ""
    assert single_folder(["a/scene.json", "__MACOSX/a/scene.json"], "scene.json") == "a"
    with pytest.raises(ArchiveRefused, match=r"a/b/scene\.json"):
        single_folder(["a/b/scene.json"], "scene.json")
    with pytest.raises(ArchiveRefused, match="2 files"):
        single_folder(["a/scene.json", "b/scene.json"], "scene.json")


def test_nothing_is_written_to_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bundle_from_bytes(tar_of(files_of(*sound_parts()), "w:gz"))
    assert list(tmp_path.iterdir()) == []


def test_a_huge_file_in_a_folder_is_not_read(tmp_path: Path) -> None:
    for name, content in files_of(*sound_parts()).items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneInvalid, match="at most 1000"):
        read_bundle(tmp_path, ArchiveLimits(total_bytes=1000))
