"""Damaged and hostile tables of markers through the command: never a traceback, one line with numbers, little
memory, and nothing left where a scene would be.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import marker_files as files
import numpy as np
import pytest

from physworld_scenes.bundle import read_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import ImportOptions, import_any
from physworld_workers.commands import importing

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
MOTION = files.made(frames=40)
SAID = ["--kind=sheet", "--mass=0.1", "--thickness=0.001"]
GIBIBYTE = 1 << 30

TEXTS: dict[str, tuple[str, bytes]] = {
    "motive": ("take.csv", files.motive(MOTION, version="1.25")),
    "motive old": ("take.csv", files.motive(MOTION, version="1.1", unlabelled=2)),
    "vicon": ("trial.csv", files.vicon(MOTION)),
    "qualisys": ("trial.tsv", files.qualisys(MOTION, heads=True, timed=True)),
    "trc": ("trial.trc", files.trc(MOTION)),
    "columns": ("tracks.csv", files.columns(MOTION)),
    "two rows": ("tracks.csv", files.columns(MOTION, naming="two rows")),
    "long": ("tracks.csv", files.long_columns(MOTION)),
}


def binaries(folder: Path) -> dict[str, tuple[str, bytes]]:
    return {
        "npz": ("tracks.npz", files.npz(MOTION)),
        "hdf5": ("tracks.h5", files.hdf5(MOTION, folder / "made.h5")),
        "mcap": ("log.mcap", files.mcap_json(MOTION)),
        "ros2": ("log.mcap", files.mcap_ros2(MOTION)),
        "c3d": ("trial.c3d", files.c3d(MOTION, folder / "made.c3d")),
    }


def outcome(data: bytes, name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command on a file; '' if it made a scene, else the one line that it said."""
    source, out = folder / "given" / name, folder / "made" / "scene"
    source.parent.mkdir(exist_ok=True)
    source.write_bytes(data)
    status = importing.main([str(source), f"--out={out}", *SAID])
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert "Traceback" not in captured.err + captured.out
    if status == 0:
        assert not lines
        read_bundle(out)
        assert sorted(path.name for path in out.iterdir()) == ["scene.json", "scene.npz"]
        for path in out.iterdir():
            path.unlink()
        out.rmdir()
        out.parent.rmdir()
        return ""
    assert status == 2 and len(lines) == 1 and lines[0].startswith("error: "), captured.err
    assert not (folder / "made").exists()
    assert sorted(path.name for path in source.parent.iterdir()) == [name]
    return lines[0]


def bent_texts(data: bytes) -> Iterator[tuple[str, bytes]]:
    """A text file, damaged in every way that people and programs damage one."""
    lines = data.splitlines(keepends=True)
    middle = lines[-10]
    mark = b"\t" if middle.count(b"\t") > middle.count(b",") else b","
    cells = middle.split(mark)
    for share in (0.02, 0.1, 0.5, 0.9, 0.999):
        yield f"cut at {share}", data[: int(share * len(data))]
    yield "without its last rows", b"".join(lines[:-15])
    yield "a row with a cell too few", data.replace(middle, mark.join(cells[:-2]) + b"\n")
    yield "a row with a cell too many", data.replace(middle, mark.join([*cells[:-1], b"7", *cells[-1:]]))
    for word in (
        b"1e308",
        b"-1e300",
        b"nan",
        b"inf",
        b"1e999",
        b"hello",
        b"=cmd|' /C calc'!A0",
        b"1_0",
        b"\xff\xfe",
        b"0x10",
    ):
        yield f"{word!r} for a number", data.replace(middle, mark.join([*cells[:-3], word, *cells[-2:]]))
    yield "a row twice", data.replace(middle, middle + middle)
    yield "rows in reverse", b"".join([*lines[:-30], *lines[:-31:-1]])
    yield "all rows alike", b"".join([*lines[:-30], *([lines[-1]] * 30)])
    yield "no row", b"".join(lines[:-40])
    yield "zero bytes", data.replace(b"0", b"\0")
    yield "UTF-16", data.decode().encode("utf-16")
    yield "with a byte order mark", b"\xef\xbb\xbf" + data
    yield "old Mac line ends", data.replace(b"\r\n", b"\n").replace(b"\n", b"\r")
    yield "hostile names", data.replace(b"M1", b"../../etc/passwd").replace(b"m1", b"../../etc/passwd")
    yield "names with quotes and line ends", data.replace(b"M2", b'"M\n2"').replace(b"m2", b'"m\n2"')
    yield "one name twice", data.replace(b"M2", b"M3").replace(b"m2", b"m3")
    yield (
        "names beyond ASCII",
        data.replace(b"M2", "Märk\N{RIGHT-TO-LEFT OVERRIDE}".encode()).replace(b"m2", "☃".encode()),
    )
    yield "no names", data.replace(b"M2", b"").replace(b"m2", b"")
    yield "commas doubled", data.replace(mark, mark + mark)
    yield "all marks gone", data.replace(mark, b" ")


@pytest.mark.parametrize("form", list(TEXTS))
def test_damaged_text_ends_in_a_scene_or_one_line(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, data = TEXTS[form]
    assert outcome(data, name, tmp_path, capsys) == ""
    refused = {}
    for what, bent in bent_texts(data):
        said = outcome(bent, name, tmp_path, capsys)
        if said:
            refused[what] = said
    assert {"zero bytes", "UTF-16", "one name twice", "a row twice"} <= set(refused)
    assert all(len(said) < 1200 for said in refused.values())
    assert re.search(r"(e\+?30|3e\+?08|e\+308)", refused["b'1e308' for a number"])


@pytest.mark.parametrize("form", ["npz", "hdf5", "mcap", "ros2", "c3d"])
def test_damaged_binaries_end_in_a_scene_or_one_line(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, data = binaries(tmp_path)[form]
    assert outcome(data, name, tmp_path, capsys) == ""
    rng = np.random.default_rng(11)
    cuts = [data[: int(share * len(data))] for share in (0.001, 0.1, 0.5, 0.9)]
    for bent in cuts:
        assert outcome(bent, name, tmp_path, capsys)
    for _ in range(5):
        changed = bytearray(data)
        for at in rng.integers(8, len(data), 6):
            changed[at] = int(rng.integers(256))
        outcome(bytes(changed), name, tmp_path, capsys)


def wide(columns: int) -> bytes:
    heads = ",".join(["time", *(f"m{i // 3}_{'xyz'[i % 3]}" for i in range(columns))])
    row = ",".join(["0.5"] * (columns + 1))
    return f"{heads}\n0.1{row[3:]}\n0.2{row[3:]}\n0.3{row[3:]}\n".encode()


def zipped(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


TWELVE, FALLING = np.ones((3, 4, 3)), np.array([0.0, 2.0, 1.0])


def in_trc(old: bytes, new: bytes) -> bytes:
    return files.trc(MOTION).replace(old, new)


def forged_npy() -> bytes:
    """An npz whose array claims 8 GB."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 350, 3)}
    )
    with zipfile.ZipFile(packed := io.BytesIO(), "w") as archive:
        archive.writestr("points.npy", stream.getvalue())
    return packed.getvalue()


HOSTILE: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "empty": ("a.csv", lambda: b"", "0 bytes"),
    "blank": ("a.csv", lambda: b"\n" * 5000, "begin with 0a"),
    "a million columns": ("a.csv", lambda: wide(1_000_000), "line 1 has"),
    "too many columns": ("a.csv", lambda: wide(60_000), "60001 columns, at most 30016"),
    "a line without an end": ("a.csv", lambda: b"time,a_x,a_y,a_z\n" + b"1" * 40_000_000, "line 2 has 40000000 bytes"),
    "a million rows of nothing": ("a.csv", lambda: b"time,a_x,a_y,a_z\n" + b",,,\n" * 1_000_000, "no row of numbers"),
    "one marker": ("a.csv", lambda: b"time,x,y,z\n0,0,0,1\n0.1,0,0,1\n0.2,0,0,1\n", "its markers are marker"),
    "one frame": ("a.csv", lambda: b"time,a_x,a_y,a_z\n0,0,0,1\n", "1 frames"),
    "text": ("a.csv", lambda: b"hello\nworld\n", "no row of numbers in its first 2 lines"),
    "two of three axes": ("a.csv", lambda: b"time,a_x,a_y\n0,0,0\n1,0,0\n", "no marker has columns x, y and z"),
    "huge rate": ("a.trc", lambda: in_trc(b"100.00\t100.00", b"1e300\t1e300"), ""),
    "no rate": ("a.csv", lambda: files.vicon(MOTION).replace(b"\n100\r", b"\n0\r"), "rate of the section"),
    "billions of markers": ("a.trc", lambda: in_trc(b"\t20\tmm", b"\t2000000000\tmm"), "NumMarkers is 2000000000"),
    "unit of nobody": ("a.trc", lambda: in_trc(b"\tmm\t", b"\tfurlong\t"), "'furlong'; known are m, cm"),
    "6D data": ("a.tsv", lambda: files.qualisys(MOTION).replace(b"\t3D", b"\t6D"), "holds '6D' data; export 3D"),
    "wrong shape": ("a.npz", lambda: zipped(points=np.zeros((5, 4, 4))), "shape (5, 4, 4); one of three dimensions"),
    "no tracks": ("a.npz", lambda: zipped(weights=np.zeros(5)), "holds no tracks"),
    "objects": ("a.npz", lambda: zipped(points=np.array([{}], dtype=object)), "never Python objects"),
    "claims 8 GB": ("a.npz", forged_npy, "claims shape (1000000, 350, 3)"),
    "times that fall": ("a.npz", lambda: zipped(points=TWELVE, times=FALLING), "not increase: 1 s in row 3"),
    "other lengths": ("a.npz", lambda: zipped(points=TWELVE, times=np.arange(7.0)), "not all 7 frames"),
}  # fmt: skip


@pytest.mark.parametrize("what", list(HOSTILE))
def test_what_nobody_means_is_refused_with_its_numbers(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, make, words = HOSTILE[what]
    said = outcome(make(), name, tmp_path, capsys)
    assert words in said
    assert said or not words


def test_hdf5_that_points_out_of_itself_is_refused(tmp_path: Path) -> None:
    import h5py

    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.ones(30_000).tobytes())
    for form in ("external link", "soft link", "external values", "virtual"):
        path = tmp_path / f"{form}.h5"
        with h5py.File(path, "w") as file:
            if form == "external link":
                file["points"] = h5py.ExternalLink(str(secret), "/points")
            elif form == "soft link":
                file["points"] = h5py.SoftLink("/elsewhere")
            elif form == "external values":
                file.create_dataset("points", (100, 100, 3), "f8", external=[(str(secret), 0, 240_000)])
            else:
                layout = h5py.VirtualLayout((100, 100, 3), "f8")
                layout[:] = h5py.VirtualSource(str(secret), "points", (100, 100, 3))
                file.create_virtual_dataset("points", layout)
        with pytest.raises(
            SceneInvalid, match=r"only what lies in the file is read|in other files, which are not read"
        ):
            import_any(path.read_bytes(), "a.h5", ImportOptions())


def test_hdf5_that_unfolds_is_refused_before_it_does(tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("points", (100_000, 10_000, 3), "f8", compression="gzip", chunks=(100, 100, 3))
    data = (tmp_path / "bomb.h5").read_bytes()
    assert len(data) < 100_000
    with pytest.raises(SceneInvalid, match="holds 24000000000 bytes or more, at most"):
        import_any(data, "a.h5", ImportOptions())


LARGEST = {
    "columns": lambda: files.columns(files.made(frames=5000, side=10), naming="dot"),
    "a million columns": lambda: wide(1_000_000),
}


@pytest.mark.parametrize("what", list(LARGEST))
def test_the_largest_files_take_less_than_a_gibibyte(what: str, tmp_path: Path) -> None:
    """1.6 million coordinates in 16 MB, and a file that is all header."""
    source = tmp_path / "large.csv"
    source.write_bytes(LARGEST[what]())
    module = "physworld_workers.commands.importing"
    command = [sys.executable, "-m", module, str(source), f"--out={tmp_path / 'scene'}", *SAID]
    # a child's peak counts what its parent held when it was forked: a small process starts it and tells
    measured = "import resource, subprocess, sys; done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL); " \
        "print(done.returncode, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"  # fmt: skip
    child = subprocess.run(
        [sys.executable, "-c", measured, *command], cwd=ROOT, capture_output=True, text=True, check=True
    )
    status, used_kib = (int(word) for word in child.stdout.split())
    assert status == (0 if what == "columns" else 2), child.stderr[-2000:]
    assert used_kib * 1024 < GIBIBYTE


def test_a_scene_that_cannot_be_written_leaves_what_was_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out = tmp_path / "take.csv", tmp_path / "scene"
    source.write_bytes(TEXTS["motive"][1])
    out.mkdir()
    (out / "scene.json").write_text("before")
    monkeypatch.setattr(
        "physworld_scenes.bundle.stream_arrays",
        lambda arrays, stream: (_ for _ in ()).throw(OSError(28, "No space left")),
    )
    assert importing.main([str(source), f"--out={out}", *SAID]) == 2
    assert "No space left" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["scene.json"]
    assert (out / "scene.json").read_text() == "before"
    assert importing.main([str(source), f"--out={tmp_path / 'a' / 'b'}", *SAID]) == 2
    assert not (tmp_path / "a").exists()
