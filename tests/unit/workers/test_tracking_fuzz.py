"""Damaged and hostile archives of pictures in the process that follows them: a scene or a refusal with its reason, less
than 1 GiB, and nothing outside of the folder that it was given.

A small process imports what a tracking's child does and forks one for each archive, under the limits of the service:
what a fork takes is its own.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import pytest
import robot_logs
from planar_filmed import BOARD, Film
from scipy.spatial.transform import Rotation
from tracking_pictured import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, write

from physworld.camera import MOST_PIXELS
from physworld_scenes.bundle import bundle_from_bytes
from physworld_workers.tracking_files import ARCHIVE, FOUND, NO_MEMORY, REFUSED, REQUEST, UPLOAD

pytestmark = pytest.mark.slow

Files = dict[str, bytes]
GIBIBYTE = 1 << 30
FRAMES = 4
OPTIONS: dict[str, Any] = {
    "kind": "sheet",
    "body": {"mass_kg": 0.05, "thickness_m": 1e-3},
    "fps": 30.0,
    "up": "-y",
    "boxes": {"0": [LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8]},
    "points": 12,
}
FORKS = """
import os, sys, traceback
from pathlib import Path
import cv2, scipy.ndimage, scipy.spatial, PIL.Image
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.first_cloud import first_cloud
from physworld_scenes.importers.unpacked import first_pictures, unpacked
from physworld_workers import tracking_child
cv2.setNumThreads(1)
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            folder = Path(line.strip())
            (folder / "seen").mkdir()
            os.link(folder / "upload", folder / "shown")
            try:
                recording = unpacked(folder / "shown", "take.zip", folder / "seen")
                if first_pictures(recording)[0] == "rgbd":
                    found = first_cloud(recording, None, {})
                    assert len(found.places) <= 5000 and abs(found.places).max(initial=0.0) < 1e9
            except SceneInvalid:
                pass
            status = tracking_child.main(folder)
        except BaseException:
            traceback.print_exc()
        sys.stderr.flush()
        os._exit(status)
    _, status, used = os.wait4(child, 0)
    print(os.waitstatus_to_exitcode(status), used.ru_maxrss, flush=True)
"""


class Child:
    """Archives are given to it one after the other."""

    def __init__(self, process: subprocess.Popen[str], place: Path) -> None:
        self._process, self._place = process, place
        self._errors = place / "errors"

    def follow(self, upload: bytes, options: dict[str, Any] | None = None) -> tuple[str, Path]:
        """What was said of an archive, '' where it became a scene; and the folder, which the next call removes."""
        folder = self._place / "folder"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / UPLOAD).write_bytes(upload)
        (folder / REQUEST).write_text(json.dumps({"file": "take.zip", "options": options or OPTIONS}))
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None
        stdin.write(f"{folder}\n")
        stdin.flush()
        status, peak_kib = (int(word) for word in stdout.readline().split())
        assert status in (0, REFUSED, NO_MEMORY), self._errors.read_text()[-3000:]
        assert peak_kib * 1024 < GIBIBYTE
        assert sorted(path.name for path in self._place.iterdir()) == ["cwd", "errors", "folder", "tmp"]
        assert not [*(self._place / "cwd").iterdir(), *(self._place / "tmp").iterdir()]
        if status == NO_MEMORY:
            return "memory", folder
        found = json.loads((folder / FOUND).read_text())
        if status == 0:
            bundle_from_bytes((folder / ARCHIVE).read_bytes())
            return "", folder
        said = "; ".join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in found["faults"])
        assert found["faults"] and 0 < len(said) < 2000
        return said, folder


@pytest.fixture(scope="module")
def child(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    place = tmp_path_factory.mktemp("fuzz")
    for name in ("cwd", "tmp"):
        (place / name).mkdir()
    paths = os.pathsep.join([os.environ.get("PYTHONPATH", ""), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths, "TMPDIR": str(place / "tmp"), "OMP_NUM_THREADS": "1"}
    with (place / "errors").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", FORKS], cwd=place / "cwd", env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
        )  # fmt: skip
        yield Child(process, place)
        process.communicate()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A recording of four pictures that becomes a scene, file by file."""
    folder = tmp_path_factory.mktemp("pictures")
    write(folder, FRAMES)
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def packed(files: Files) -> bytes:
    buffer: IO[bytes] = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    buffer.seek(0)
    return buffer.read()


def encoded(picture: np.ndarray, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, picture)[1])


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(
    width: int, height: int, colours: int = 2, bits: int = 8, extra: bytes = b"", rows: bytes = b""
) -> bytes:
    """A PNG that declares what is said, and has these rows."""
    head = struct.pack(">IIBBBBB", width, height, bits, colours, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(rows, 9))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + data + chunk(b"IEND", b"")


def bomb(width: int, height: int) -> bytes:
    """A black picture that is there as a whole, and a thousandth of its size."""
    return png(width, height, rows=bytes((1 + 3 * width) * height))


def npy(array: np.ndarray, claimed: tuple[int, ...] | None = None) -> bytes:
    buffer = io.BytesIO()
    if claimed is None:
        np.save(buffer, array)
    else:
        header = {"descr": "<f4", "fortran_order": False, "shape": claimed}
        np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue()


def lens(**facts: object) -> bytes:
    known = {
        "width": WIDTH,
        "height": HEIGHT,
        "intrinsic_matrix": [200.0, 0, 0, 0, 200.0, 0, 80.0, 60.0, 1.0],
    }
    return json.dumps(known | facts).encode()


def put(make: Callable[[], Files]) -> Callable[[Files], Files]:
    """Files in the place of others, made when they are wanted."""
    return lambda files: files | make()


def without(*parts: str) -> Callable[[Files], Files]:
    """The files without those whose paths hold one of these."""
    return lambda files: {n: data for n, data in files.items() if not any(part in n for part in parts)}


def margin(kind: bytes) -> bytes:
    """A picture with 32 MiB of zeros, packed, in a chunk beside its pixels."""
    return png(WIDTH, HEIGHT, extra=chunk(kind, b"x\0\0" + zlib.compress(bytes(1 << 25))))


def in_depth(*arrays: bytes) -> Callable[[Files], Files]:
    """Depth as arrays, the last one again and again."""
    return lambda files: (
        without("depth")(files) | {f"depth/{i}.npy": arrays[min(i, len(arrays) - 1)] for i in range(FRAMES)}
    )


def named(*names: str) -> Callable[[Files], Files]:
    """Colours under other names, in the archive's order."""
    return lambda files: {
        (f"color/{names[int(name[6:-4])]}" if name.startswith("color") else name): data
        for name, data in files.items()
    }


def cut(name: str, share: float) -> Callable[[Files], Files]:
    return lambda files: files | {name: files[name][: int(share * len(files[name]))]}


def alike(kind: str, make: Callable[[], bytes]) -> Callable[[Files], Files]:
    """All pictures of a kind are this one."""
    return lambda files: files | dict.fromkeys((name for name in files if name.startswith(kind)), make())


NEAR = np.full((HEIGHT, WIDTH), 0.5, np.float32)
WILD = NEAR.copy()
WILD.flat[::7], WILD.flat[1::7], WILD.flat[2::7], WILD.flat[3::7] = np.nan, np.inf, -1.0, 1e38
LARGE = np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
SVG = b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd"/></svg>'

HOSTILE: dict[str, tuple[Callable[[Files], Files], str]] = {
    "no byte of a colour": (cut("color/1.png", 0.0), "1.png: is no picture"),
    "a colour's head": (cut("color/0.png", 0.001), "0.png: is no picture"),
    "half a colour": (cut("color/2.png", 0.5), "2.png: is damaged"),
    "half a depth": (cut("depth/2.png", 0.5), "2.png: is damaged"),
    "half a lens": (cut("camera_intrinsic.json", 0.5), "camera_intrinsic.json: "),
    "half a JPEG": (put(lambda: {"color/1.png": encoded(LARGE, ".jpg")[:400]}), "1.png: "),
    "a colour of another size": (put(lambda: {"color/1.png": encoded(LARGE)}), "320 x 240 pixels, the first"),
    "depth of another size": (put(lambda: {"depth/0.png": encoded(LARGE[..., 0])}), "320 x 240 pixels, the first"),
    "depth of colours": (put(lambda: {"depth/1.png": encoded(LARGE[:HEIGHT, :WIDTH])}), "a picture of colours (RGB)"),
    "a row of pixels": (put(lambda: {"color/0.png": encoded(LARGE[:1])}), "320 x 1 pixels; 16 a side"),
    "a lens of another size": (put(lambda: {"camera_intrinsic.json": lens(width=9, height=9)}), ""),
    "no focal length": (put(lambda: {"camera_intrinsic.json": lens(intrinsic_matrix=[0.0] * 9)}), "invertible"),
    "a lens of words": (put(lambda: {"camera_intrinsic.json": lens(intrinsic_matrix=["x"] * 9)}), "intrinsic"),
    "a lens of NaN": (put(lambda: {"camera_intrinsic.json": lens(intrinsic_matrix=[float("nan")] * 9)}), ""),
    "a lens of 1e300": (put(lambda: {"camera_intrinsic.json": lens(intrinsic_matrix=[1e300] * 9)}), ""),
    "a lens of brackets": (put(lambda: {"camera_intrinsic.json": b"[" * 200_000}), "camera_intrinsic.json"),
    "a colour that claims 100,000 a side": (put(lambda: {"color/1.png": png(100_000, 100_000)}), "1.png: "),
    "a colour that claims 2**31 - 1 a side": (put(lambda: {"color/0.png": png(2**31 - 1, 2**31 - 1)}), "0.png: "),
    "depth that claims 60,000 a side": (put(lambda: {"depth/0.png": png(60_000, 60_000, 0, 16)}), "0.png: "),
    "a bomb beside the others": (put(lambda: {"color/1.png": bomb(2048, 2048)}), "2048 x 2048 pixels, the"),
    "only bombs": (alike("color", lambda: bomb(4096, 4097)), "4096 x 4097 pixels; 16 a side"),
    "a bomb in the margin": (put(lambda: {"color/0.png": margin(b"iCCP")}), "0.png: "),
    "text that unfolds": (put(lambda: {"color/0.png": margin(b"zTXt")}), "0.png: "),
    "a depth array that claims 8 GB": (in_depth(npy(NEAR, (40_000, 50_000))), "0.npy: "),
    "a depth array of objects": (in_depth(npy(np.array([{}], dtype=object))), "0.npy: "),
    "a depth array on its side": (in_depth(npy(NEAR.T)), "shape (160, 120), colours have (120, 160)"),
    "a depth array of three axes": (in_depth(npy(NEAR[..., None])), "shape (120, 160, 1)"),
    "depth that is not finite": (in_depth(npy(WILD)), ""),
    "depth of complex numbers": (in_depth(npy(NEAR * 1j)), ""),
    "depth of truths": (in_depth(npy(NEAR > 0)), ""),
    "no depth anywhere": (alike("depth", lambda: encoded(np.zeros((HEIGHT, WIDTH), np.uint16))), "depth"),
    "no picture": (lambda files: {"color/a": b"", "depth/a": b""}, "holds 0 pictures"),
    "one picture": (without("1.png", "2.png", "3.png"), "1 of 1 frames are read"),
    "no lens": (without("camera_intrinsic.json"), "says nothing of its lens"),
    "a depth too few": (without("depth/3.png"), "3 frames of depth and 4 of colour"),
    "17 cameras": (lambda files: {f"{p}/{i}/0.png": b"" for i in range(17) for p in ("color", "depth")}, "17 camera"),
    "digits of another kind": (named("0²³.png", "1\N{ARABIC-INDIC DIGIT TWO}.png", "①.png", "½.png"), ""),
    "names of many digits": (named(*(f"{'9' * 200}{i}.png" for i in range(4))), ""),
    "line ends and turns": (named("a\nb.png", "\N{RIGHT-TO-LEFT OVERRIDE}g.png", "$(id).png", "-rf.png"), ""),
    "a name of spaces": (named(" .png", "  .png", "   .png", "    .png"), ""),
    "a picture that is a folder": (put(lambda: {"color/9.png/0.png": b""}), "and 1 of colour"),
    "a text": (put(lambda: {"color/0.png": b"no picture at all"}), "0.png: is no picture"),
    "an SVG that names a file": (put(lambda: {"color/0.png": SVG}), "0.png: is no picture"),
    "a GIF": (put(lambda: {"color/0.png": b"GIF89a" + bytes(100)}), "0.png: is no picture"),
    "a TIFF": (put(lambda: {"color/0.png": encoded(LARGE, ".tiff")}), "0.png: is no picture"),
    "a program": (put(lambda: {"color/0.png": b"\x7fELF" + bytes(100)}), "0.png: is no picture"),
    "noise": (put(lambda: {"color/0.png": np.random.default_rng(0).bytes(5000)}), "0.png: is no picture"),
    "no film": (lambda files: without("color")(files) | {"color/0.mp4": bytes(500)}, "0.mp4: is no film"),
}  # fmt: skip


@pytest.mark.parametrize("what", list(HOSTILE))
def test_pictures_that_nobody_means_are_refused_with_the_reason(
    child: Child, sound: Files, what: str
) -> None:
    """Where no words are asked for, a scene is as good."""
    change, words = HOSTILE[what]
    said, _ = child.follow(packed(change(sound)))
    assert words in said and (said or not words), said


def test_pictures_are_read_in_the_order_of_their_numbers(child: Child, sound: Files) -> None:
    said, folder = child.follow(packed(sound))
    assert said == ""
    plain = bundle_from_bytes((folder / ARCHIVE).read_bytes())[0]
    numbers = ("view 2.png", "view 9.png", "view 10.png", "view 110.png")
    shuffled = dict(reversed(named(*numbers)(sound).items()))
    said, folder = child.follow(packed(shuffled))
    assert said == ""
    again = bundle_from_bytes((folder / ARCHIVE).read_bytes())[0]
    assert np.array_equal(again.points, plain.points) and len(plain.points) == FRAMES


OPTIONS_OF_NOBODY: dict[str, tuple[dict[str, Any], str]] = {
    "depth in light years": ({"depth_scale": 1e-300}, "depth"),
    "depth in atoms": ({"depth_scale": 1e9}, ""),
    "metres for millimetres": ({"depth_scale": 1.0}, ""),
    "frames behind the end": ({"first": 900}, "0 of 4 frames are read"),
    "frames in reverse": ({"first": 3, "last": 2}, "0 of 4 frames are read"),
    "a box beside the picture": ({"boxes": {"0": [900, 900, 950, 950]}}, "nothing of the picture"),
    "a box in reverse": ({"boxes": {"0": [90, 90, 10, 10]}}, ""),
    "a box of a camera that is not": ({"boxes": {"3": [0, 0, 9, 9]}}, "box: is of camera 3"),
    "more points than pixels": ({"points": 20_000}, ""),
    "a mask that is the lens": ({"masks": {"0": "camera_intrinsic.json"}}, "is no mask"),
    "a mask of another size": ({"masks": {"0": "large.png"}}, "has (320, 240) pixels"),
    "a mask that claims 100,000 a side": ({"masks": {"0": "claims.png"}}, "claims.png: is no mask"),
    "tracks that are pictures": ({"tracks": {"0": "color/0.png"}}, "0.png"),
    "a log that is a picture": ({"gripper": {"log": "color/0.png", "held_px": [60, 50, 70, 60]}}, "0.png"),
    "a log that is cut short": (
        {"gripper": {"log": "cut.mcap", "held_px": [60, 50, 70, 60]}},
        "cut.mcap: cannot be read",
    ),
    "a log of joints": (
        {"gripper": {"log": "set/joints.parquet", "held_px": [60, 50, 70, 60]}},
        "no x, y and z of an end effector",
    ),
    "a log outside": (
        {"gripper": {"log": "../../request.json", "held_px": [60, 50, 70, 60]}},
        "is no file of the archive",
    ),
    "an episode of pictures": (
        {"gripper": {"log": "color/0.png", "log_episode": 3, "held_px": [60, 50, 70, 60]}},
        "0.png: is no data set of LeRobot: it has no episode 3",
    ),
    "a log of nothing": ({"gripper": {"log": "empty.csv", "held_px": [60, 50, 70, 60]}}, "empty.csv"),
    "a plane beside depth": ({"plane": {"board": "charuco:7x5:0.04:0.03"}}, "is of a film"),
    "gravity of nobody": ({"gravity_m_s2": [1e300, 0, 0]}, ""),
    "a body of nobody": ({"body": {"mass_kg": "heavy", "x": {"y": [[]]}}}, "body"),
}


def robot_files() -> Files:
    """Logs of a robot: MCAP whole and cut, and a data set of joints."""
    times = np.arange(20) / 30.0
    whole = robot_logs.mcap_pose(times, *robot_logs.path_of(times))
    with tempfile.TemporaryDirectory() as folder:
        robot_logs.lerobot_info(Path(folder), ["shoulder.pos", "elbow.pos"])
        robot_logs.lerobot_file(Path(folder) / "joints.parquet", {0: (times, np.zeros((20, 2)))})
        held = {
            f"set/{name}": (Path(folder) / name).read_bytes() for name in ("joints.parquet", "meta/info.json")
        }
    return {"tool.mcap": whole, "cut.mcap": whole[: len(whole) // 2], **held}


def test_a_log_in_an_archive_moves_the_gripper(child: Child, sound: Files) -> None:
    grip = {"log": "tool.mcap", "log_pose": "/tool/pose", "held_px": [60, 50, 70, 60]}
    said, folder = child.follow(packed(sound | robot_files()), OPTIONS | {"gripper": grip})
    assert said == ""
    scene = bundle_from_bytes((folder / ARCHIVE).read_bytes())[0]
    places, turns = robot_logs.path_of(np.arange(FRAMES) / 30.0)
    rotation = Rotation.from_quat(turns[:, [1, 2, 3, 0]])
    held = rotation[0].inv().apply(scene.controllers[0] - places[0])
    wanted = np.stack([turn.apply(held) + place for turn, place in zip(rotation, places, strict=True)])
    assert np.abs(scene.controllers - wanted).max() < 1e-6


@pytest.mark.parametrize("what", list(OPTIONS_OF_NOBODY))
def test_options_that_do_not_fit_the_pictures_are_refused(child: Child, sound: Files, what: str) -> None:
    options, words = OPTIONS_OF_NOBODY[what]
    beside = {
        "large.png": encoded(LARGE),
        "claims.png": png(100_000, 100_000),
        "empty.csv": b"",
        **robot_files(),
    }
    said, _ = child.follow(packed(sound | beside), OPTIONS | options)
    assert words in said and (said or not words), said


def test_changed_bytes_end_in_a_scene_or_a_refusal(child: Child, sound: Files) -> None:
    rng = np.random.default_rng(5)
    for _ in range(12):
        name = list(sound)[int(rng.integers(len(sound)))]
        content = bytearray(sound[name])
        for at in rng.integers(8, len(content), 4):
            content[at] = int(rng.integers(256))
        child.follow(packed(sound | {name: bytes(content)}))
    archive = packed(sound)
    for share in (0.1, 0.6, 0.99):
        assert "take.zip: " in child.follow(archive[: int(share * len(archive))])[0]


def test_damaged_films_end_in_a_scene_or_a_refusal(child: Child, tmp_path: Path) -> None:
    film = Film()
    data = film.write(tmp_path / "strip.mp4", FRAMES).read_bytes()
    box = [int(part) for part in film.box().split(",")]
    options = {"kind": "beam", "boxes": {"0": box}, "plane": {"board": BOARD}, "points": 12}
    options |= {"body": {"thickness_m": 0.004}}
    assert child.follow(data, options)[0] == ""
    sizes = data.index(b"mp4v", data.index(b"stsd")) + 28  # width and height, where the film describes itself
    length = data.index(b"mvhd") + 16  # its clock and its length
    claims = [data[:at] + b"\xff" * 4 + data[at + 4 :] for at in (sizes, length, length + 4)]
    for share in (0.02, 0.3):
        assert child.follow(data[: int(share * len(data))], options)[0]
    claims.append(data[: int(0.9 * len(data))])  # part of the last frame, which decoders make up for
    rng = np.random.default_rng(6)
    for bent in (*claims, *(bytearray(data) for _ in range(6))):
        if isinstance(bent, bytearray):
            for at in (*rng.integers(32, 900, 2), *rng.integers(900, len(data), 2)):
                bent[at] = int(rng.integers(256))
        child.follow(bytes(bent), options)


def test_large_pictures_meet_the_limit_or_become_a_scene(child: Child, sound: Files) -> None:
    """Two of the largest pictures that are read, black and without an object: 600 MB of depth and colour if all were
    held at once."""
    side = int(MOST_PIXELS**0.5)
    depth = encoded(np.full((side, side), 500, np.uint16))
    files = {f"color/{i}.png": bomb(side, side) for i in range(2)} | {
        f"depth/{i}.png": depth for i in range(2)
    }
    files["camera_intrinsic.json"] = lens(width=side, height=side)
    assert child.follow(packed(files))[0]
