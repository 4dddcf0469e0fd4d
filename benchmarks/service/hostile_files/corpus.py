"""The corpus: files that follow from a seed, of every form that the service reads, bent, forged or swollen.

A third is mutated bytes of sound files, the rest is forged: JSON that means something else, archives that lie about
themselves, arrays of impossible shapes, pickles that call functions. Whatever would write a file or run a command, if
anybody obeyed it, leaves a trace that ``traces`` finds.
"""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import pickle
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np

from benchmarks.service.hostile_files import bombs
from benchmarks.service.hostile_files.bombs import unzipped, zipped
from benchmarks.service.hostile_files.pieces import (
    CALLS,
    CANARY,
    KINDS,
    LENGTHS,
    NAMES,
    SIZES,
    TYPES,
    WORDS,
    mutated,
    one,
    value,
)  # fmt: skip
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld_scenes.bundle import canonical_archive


@dataclass(frozen=True)
class Hostile:
    """One file of the corpus: where it came from, what its sender calls it, its content."""

    family: str
    filename: str
    content: bytes


class Corpus:
    """Hostile files by number; the same folder, seed and number give the same file, whatever was made before.

    Args:
        folder: where pickles and archives would leave their traces; also room for the sound C3D file.
    """

    def __init__(self, folder: Path, bundle: bytes, seed: int = 0) -> None:
        self._folder, self._bundle, self._seed = folder, bundle, seed
        self._parts = unzipped(bundle)
        self.sound = {
            "scene.zip": bundle,
            "scene.tar": _tar(self._parts),
            "scene.tar.gz": gzip.compress(_tar(self._parts), mtime=0),
            "final_data.pkl": pickle.dumps(_physical_twin(), protocol=4),
            "arm.c3d": _c3d(folder / "sound.c3d"),
        }
        self._families: dict[str, Callable[[np.random.Generator], tuple[str, bytes]]] = {
            "bytes changed": self._changed,
            "bytes changed within": self._changed_within,
            "declaration": self._declaration,
            "arrays": self._arrays,
            "array header": self._header,
            "zip": self._zip,
            "tar": self._tar_file,
            "pickle": self._pickle,
            "c3d": self._c3d_header,
            "swollen": self._swollen,
            "bomb": self._bomb,
        }

    def file(self, number: int) -> Hostile:
        """The file of this number."""
        rng = np.random.default_rng([self._seed, number])
        family = list(self._families)[number % len(self._families)]
        filename, content = self._families[family](rng)
        return Hostile(family, filename, content)

    def known(self) -> Iterator[Hostile]:
        """Every known bomb at full size, under the file name of its type."""
        for name, bomb in bombs.BOMBS.items():
            yield Hostile(name, bomb.filename, bomb.make(self._bundle))

    def _changed(self, rng: np.random.Generator) -> tuple[str, bytes]:
        name = str(rng.choice(list(self.sound)))
        return name, mutated(rng, self.sound[name])

    def _changed_within(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """The archive is sound, what is in it is not."""
        parts = dict(self._parts)
        if rng.random() < 0.5:
            parts["scene.json"] = mutated(rng, parts["scene.json"])
        else:
            arrays = unzipped(parts["scene.npz"])
            chosen = str(rng.choice(list(arrays)))
            parts["scene.npz"] = zipped({**arrays, chosen: mutated(rng, arrays[chosen])})
        return "scene.zip", zipped(parts)

    def _declaration(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Up to three places of ``scene.json`` hold something else, or are gone, or are new."""
        document = json.loads(self._parts["scene.json"])
        for _ in range(rng.integers(1, 4)):
            holder: Any = document
            while True:
                keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
                key = keys[int(rng.integers(len(keys)))] if keys else "more"
                inner = holder[key] if keys else None
                if isinstance(inner, dict | list) and inner and rng.random() < 0.7:
                    holder = inner
                    continue
                break
            if isinstance(holder, dict):
                if rng.random() < 0.2:
                    key = str(rng.choice(["more", "__class__", "\x00", "body", "grips", "x" * 5000]))
                holder[key] = value(rng)
            elif keys:
                holder[key] = value(rng)
        text = json.dumps(document) if rng.random() < 0.9 else json.dumps(document).replace(":", ":" * 2, 1)
        return "scene.zip", zipped({**self._parts, "scene.json": text.encode("utf-8", "surrogatepass")})

    def _arrays(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """An array of another shape, type or content."""
        with np.load(io.BytesIO(self._parts["scene.npz"])) as stored:
            arrays = {name: stored[name] for name in stored.files}
        name = str(rng.choice(list(arrays)))
        array = arrays[name]
        match int(rng.integers(8)):
            case 0:
                array = array[: int(rng.integers(0, 3))]
            case 1:
                array = np.moveaxis(array, 0, -1) if array.ndim else array[None]
            case 2:
                array = array.astype(rng.choice(np.array(["f2", "i8", "c16", "U5", "M8[s]", "?", "S3"])))
            case 3:
                array = np.where(
                    rng.random(array.shape) < 0.1, rng.choice([np.nan, np.inf, -np.inf, 1e308]), array
                )
            case 4:
                array = np.zeros([int(rng.integers(0, 4)) for _ in range(rng.integers(0, 6))])
            case 5:
                array = array[..., :1].repeat(int(rng.integers(1, 3000)), axis=-1) if array.ndim else array
            case 6:
                array = np.array([{"a": 1}, None], dtype=object)
            case _:
                array = (
                    array * float(rng.choice([0.0, 1e-300, 1e300, -1.0, 1000.0]))
                    if array.dtype != bool
                    else ~array
                )
        arrays[name] = array
        if rng.random() < 0.2:
            del arrays[str(rng.choice(list(arrays)))]
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=True, **arrays)
        return "scene.zip", zipped({**self._parts, "scene.npz": buffer.getvalue()})

    def _header(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """A header of an array that promises the impossible."""
        shape = "(" + f"{one(rng, LENGTHS)}," * one(rng, (0, 1, 2, 3, 32, 33, 64, 65, 500)) + ")"
        order = one(rng, ("False", "True", "1", "None"))
        header = f"{{'descr': {one(rng, TYPES)}, 'fortran_order': {order}, 'shape': {shape}, }}"
        if rng.random() < 0.2:
            header = "(" * int(rng.choice([90, 200, 5000])) + header
        return "scene.zip", bombs.with_npy(self._bundle, header[:60_000], bytes(int(rng.integers(0, 4096))))

    def _zip(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Names that lead elsewhere, members that lie about their size, directories that lie about their members."""
        files: dict[str, bytes] = dict(self._parts)
        for _ in range(int(rng.integers(1, 4))):
            files[self._elsewhere(rng)] = rng.bytes(20)
        data = bytearray(
            zipped(files, int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])))
        )
        match int(rng.integers(5)):
            case 0:  # a field of the directory
                place = data.rfind(b"PK\x01\x02", 0, int(rng.integers(len(data) // 2, len(data))))
                field = place + int(rng.integers(4, 46))
                data[field : field + 4] = rng.bytes(4)
            case 1:  # a field of the directory's end
                field = data.rfind(b"PK\x05\x06") + int(rng.integers(4, 22))
                data[field : field + 2] = rng.bytes(2)
            case 2:  # an archive before, an archive behind
                data = bytearray(self._bundle) + data
            case 3:  # 64-bit end that points anywhere
                data += struct.pack("<4sLQL", b"PK\x06\x07", 0, int(rng.integers(2**62)), 1) + bytes(
                    data[-22:]
                )
        return str(rng.choice(["scene.zip", "../../x.zip", "a\x00b.zip", "é" * 300, ""])), bytes(data)

    def _tar_file(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Links, devices, names that lead elsewhere, sizes in every notation, sparse maps, PAX and GNU headers."""
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=int(rng.integers(3))) as archive:
            for name, content in self._parts.items():
                archive.addfile(_member(name, len(content)), io.BytesIO(content))
            for _ in range(int(rng.integers(1, 4))):
                entry = _member(self._elsewhere(rng)[:90], 0)
                entry.type = one(rng, KINDS)
                entry.linkname = str(rng.choice(["/etc/passwd", "scene.json", "..", "a" * 90]))
                archive.addfile(entry)
        data = bytearray(buffer.getvalue())
        if rng.random() < 0.5:
            block = 512 * int(rng.integers(len(data) // 512))
            data[block + 124 : block + 136] = one(rng, SIZES)
            total = sum(data[block : block + 512]) - sum(data[block + 148 : block + 156]) + 8 * 32
            data[block + 148 : block + 156] = b"%06o\0 " % total
        packers = [bytes, lambda tar: gzip.compress(tar, mtime=0), bz2.compress, lzma.compress]
        packed = packers[int(rng.integers(4))](bytes(data))
        return str(rng.choice(["scene.tar", "scene.tar.gz", "scene.tgz", "scene"])), packed

    def _pickle(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Opcodes that call, that build more than they say, that never end."""
        canary = str(self._folder / CANARY)
        words = (canary, f"touch {canary}", f"open({canary!r}, 'w')", f"__import__('os').mkdir({canary!r})")
        match int(rng.integers(7)):
            case 0:
                argument = one(rng, words).encode()
                text = b"X" + struct.pack("<L", len(argument)) + argument
                data = b"\x80\x02c" + one(rng, CALLS) + b"\n(" + text + b"tR."
            case 1:
                data = bombs.shared_lists(int(rng.integers(2, 40)), int(rng.integers(5, 60)))
            case 2:  # a tower
                depth, back = int(rng.integers(10, 200_000)), int(rng.integers(10, 1000))
                data = b"\x80\x04" + b"]" * depth + b"a" * back + b"."
            case 3:  # lengths that are not there
                data = (
                    b"\x80\x05"
                    + one(rng, (b"X", b"\x8d", b"B", b"\x8e", b"\x8b", b"\x96"))
                    + rng.bytes(8)
                    + b"."
                )
            case 4:  # a number of many digits
                data = b"\x80\x02L" + b"9" * int(rng.integers(1000, 200_000)) + b"L\n."
            case 5:  # an array that is larger than its file
                shape = pickle.dumps(tuple(int(10 ** rng.uniform(0, 9)) for _ in range(3)), protocol=2)
                whole = pickle.dumps(_physical_twin() | {"object_points": np.zeros((7, 7, 3))}, protocol=2)
                data = whole.replace(b"K\x07K\x07K\x03", shape[2 : shape.index(b"\x87")])
            case _:
                data = mutated(rng, self.sound["final_data.pkl"])
        return "final_data.pkl", data

    def _c3d_header(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Words of the header and of the parameters, which say how much follows."""
        data = bytearray(self.sound["arm.c3d"])
        for _ in range(int(rng.integers(1, 6))):
            place = int(rng.integers(1, min(len(data), 2048) // 2)) * 2
            data[place : place + 2] = one(rng, WORDS)
        return "arm.c3d", bytes(data)

    def _swollen(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """Little that unfolds to much, by compression."""
        size = int(10 ** rng.uniform(6.0, 8.0))
        filling = [b"\0", b"[],", b" ", b'"a",', b"9"][int(rng.integers(5))]
        much = (filling * (size // len(filling) + 1))[:size]
        match int(rng.integers(5)):
            case 0:
                return "scene.zip", zipped({**self._parts, "scene.json": b'{"more": [' + much + b"1]}"})
            case 1:
                return "scene.zip", zipped({**self._parts, "scene.npz": zipped({"points.npy": much})})
            case 2:
                return "scene.tar.gz", gzip.compress(_tar({**self._parts, "scene.json": much}), 6, mtime=0)
            case 3:
                return "scene.tar.xz", lzma.compress(_tar({"scene.json": much}), preset=0)
            case _:
                return "scene.zip", zipped({f"{index}": b"" for index in range(size // 20_000)} | self._parts)

    def _bomb(self, rng: np.random.Generator) -> tuple[str, bytes]:
        """One that is known, at its size or another."""
        match int(rng.integers(8)):
            case 0:
                return "scene.zip", bombs.many_empty_lists(self._bundle, int(10 ** rng.uniform(3, 6.7)))
            case 1:
                return "scene.zip", bombs.many_edges(self._bundle, int(10 ** rng.uniform(3, 6.3)))
            case 2:
                return "scene.zip", bombs.unread_keys(self._bundle, int(10 ** rng.uniform(2, 5.5)))
            case 3:
                return "scene.tar", bombs.long_digits(int(10 ** rng.uniform(1, 6)))
            case 4:
                kinds = [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK]
                return "scene.tar", bombs.chained_headers(
                    kinds[int(rng.integers(4))], int(10 ** rng.uniform(0, 4))
                )
            case 5:
                return "scene.zip", bombs.huge_directory(int(10 ** rng.uniform(1, 6.5)))
            case _:
                bomb = one(rng, list(bombs.BOMBS.values()))
                return bomb.filename, bomb.make(self._bundle)

    def _elsewhere(self, rng: np.random.Generator) -> str:
        """A member's name that leads out of any folder, or is none."""
        return one(rng, (*NAMES, f"{self._folder}/{CANARY}"))


def sound_bundle(frames: int = 20, points: int = 9) -> bytes:
    """The archive that the corpus starts from: a strip of 0.2 m whose points follow the grip at its end."""
    times = np.arange(frames) / 30.0
    shift = np.zeros((frames, 1, 3))
    shift[:, 0, 0] = 0.05 * np.sin(4.0 * times)
    rest = np.stack([np.linspace(0.0, 0.2, points), np.zeros(points), np.full(points, 0.51)], axis=1)
    low, high = np.array([0.0, -0.01, 0.5]), np.array([0.2, 0.01, 0.52])
    scene = Scene(
        name="strip",
        kind="beam",
        points=rest + shift,
        visible=np.ones((frames, points), dtype=bool),
        controllers=rest[:1] + shift,
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=1e-4,
        train=(0, 14),
        test=(14, frames),
        initial_state=UNDEFORMED_AT_REST,
        fps=30.0,
        body=Body(box_min_m=low, box_max_m=high, density_kg_m3=1000.0),
        grips=(Grip(controllers=(0,), region_min_m=low, region_max_m=np.array([0.02, 0.01, 0.52])),),
    )
    return canonical_archive(scene)


def _member(name: str, size: int) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size = size
    return entry


def _tar(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, content in files.items():
            archive.addfile(_member(name, len(content)), io.BytesIO(content))
    return buffer.getvalue()


def _physical_twin() -> dict[str, Any]:
    """A sound ``final_data.pkl``: a cloud above the ground of a z-down world, lifted."""
    rng = np.random.default_rng(5)
    cloud = rng.uniform(-0.1, 0.1, (40, 3)) - [0.0, 0.0, 0.2]
    lift = np.linspace(0.0, 0.1, 20)[:, None, None] * np.array([0.0, 0.0, -1.0])
    seen = np.ones((20, 40), bool)
    return {
        "object_points": (cloud + lift).astype(np.float32),
        "object_colors": rng.random((20, 40, 3)).astype(np.float32),
        "object_visibilities": seen,
        "object_motions_valid": seen,
        "controller_points": (rng.uniform(-0.1, 0.1, (30, 3)) - [0, 0, 0.3] + lift).astype(np.float32),
        "surface_points": rng.uniform(-0.1, 0.1, (50, 3)) - [0.0, 0.0, 0.2],
        "interior_points": rng.uniform(-0.1, 0.1, (60, 3)) - [0.0, 0.0, 0.2],
    }


def _c3d(path: Path) -> bytes:
    """A sound C3D file of six markers."""
    names = ["tip1", "tip2", "tip3", "base1", "base2", "base3"]
    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    made["parameters"]["POINT"]["LABELS"]["value"] = names
    made.add_parameter("POINT", "UNITS", ["mm"])
    content = np.ones((4, len(names), 30))
    content[:3] = np.random.default_rng(3).uniform(0, 300, (3, len(names), 30))
    made["data"]["points"] = content
    made.write(str(path))
    return path.read_bytes()
