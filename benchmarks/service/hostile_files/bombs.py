"""Small files that unfold: each cost an earlier version of the service seconds, gigabytes or an error 500."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import struct
import tarfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass


def zipped(files: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A ZIP archive of these files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


def unzipped(data: bytes) -> dict[str, bytes]:
    """The files of a ZIP archive that is to be trusted."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def declared(bundle: bytes, **changes: object) -> bytes:
    """A bundle whose ``scene.json`` has these keys instead of its own."""
    files = unzipped(bundle)
    return zipped({**files, "scene.json": json.dumps(json.loads(files["scene.json"]) | changes).encode()})


def with_npy(bundle: bytes, header: str, content: bytes = b"\0" * 8) -> bytes:
    """A bundle whose only array has this header."""
    text = header.encode().ljust(118) + b"\n"
    npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content
    return zipped({**unzipped(bundle), "scene.npz": zipped({"points.npy": npy})})


def shared_lists(width: int = 12, depth: int = 7) -> bytes:
    """A pickle of lists, each of which holds the one below it ``width`` times."""
    shared: list[object] = []
    for _ in range(depth):
        shared = [shared] * width
    return pickle.dumps(shared, protocol=4)


def many_empty_lists(bundle: bytes, count: int = 5_000_000) -> bytes:
    """Empty lists under a key that nobody reads."""
    return zipped({**unzipped(bundle), "scene.json": b'{"more": [' + b"[]," * count + b"[]]}"})


def many_edges(bundle: bytes, count: int = 2_000_000) -> bytes:
    """Edges between the same two points."""
    return declared(bundle, body={"topology": {"edges": [[0, 1]] * count}})


def unread_keys(bundle: bytes, count: int = 20_000) -> bytes:
    """Text under a key that nobody reads."""
    return declared(bundle, remarks=["nobody reads this"] * count)


def long_digits(count: int = 60_000) -> bytes:
    """A tar whose PAX header claims a length of many digits (CVE-2024-6232)."""
    header = tarfile.TarInfo("./PaxHeaders/scene.json")
    header.type, content = tarfile.XHDTYPE, b"1" * count
    header.size = len(content)
    return header.tobuf(tarfile.USTAR_FORMAT) + content.ljust(-(-len(content) // 512) * 512, b"\0")


def chained_headers(kind: bytes, count: int = 1_000) -> bytes:
    """A compressed tar of headers that each announce another."""
    header = tarfile.TarInfo("more")
    header.type, header.size = kind, 512
    content = b"name" if kind == tarfile.GNUTYPE_LONGNAME else b"13 path=name\n"
    tar = (header.tobuf(tarfile.GNU_FORMAT) + content.ljust(512, b"\0")) * count + b"\0" * 1024
    return gzip.compress(tar, mtime=0)


def huge_directory(count: int = 3_000_000) -> bytes:
    """A ZIP whose directory holds many entries of 47 bytes, more than its end says; their name is ``a``."""
    entry = struct.pack("<4s4B4HL2L5H2L", b"PK\x01\x02", *[0] * 11, 1, *[0] * 6) + b"a"
    directory = entry * count
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 65535, 65535, len(directory), 4, 0)
    return b"PK\x03\x04" + directory + end


def nameless_member() -> bytes:
    """A ZIP with a member whose name is empty."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(zipfile.ZipInfo(""), b"")
    return buffer.getvalue()


@dataclass(frozen=True)
class Bomb:
    """How a bomb is made of a sound bundle, and the file name under which the service looks into it."""

    filename: str
    make: Callable[[bytes], bytes]


BOMBS: dict[str, Bomb] = {
    "lists that share one child": Bomb("final_data.pkl", lambda bundle: shared_lists()),
    "five million lists under an unknown key": Bomb("scene.zip", many_empty_lists),
    "two million edges": Bomb("scene.zip", many_edges),
    "keys that nobody reads": Bomb("scene.zip", unread_keys),
    "a length of 60,000 digits": Bomb("scene.tar", lambda bundle: long_digits()),
    "a thousand PAX headers": Bomb("scene.tar.gz", lambda bundle: chained_headers(tarfile.XHDTYPE)),
    "a thousand long names": Bomb("scene.tar.gz", lambda bundle: chained_headers(tarfile.GNUTYPE_LONGNAME)),
    "a directory of three million entries": Bomb("scene.zip", lambda bundle: huge_directory()),
    "a member without a name": Bomb("scene.zip", lambda bundle: nameless_member()),
    "a shape of True": Bomb(
        "scene.zip",
        lambda bundle: with_npy(bundle, "{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }"),
    ),
    "seventy dimensions": Bomb(
        "scene.zip",
        lambda bundle: with_npy(
            bundle, "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 70 + "), }"
        ),
    ),
}
"""At full size, by what makes each one a bomb."""
