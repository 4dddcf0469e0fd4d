"""What hostile files are made of: words that forms seldom expect, and bytes changed at random."""

from __future__ import annotations

import copy
import struct
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Thing = TypeVar("Thing")

CANARY = "hostile-canary"
"""In the name of every file that a hostile file would have written."""
NAMES = (
    f"../{CANARY}", f"../../../../../../tmp/{CANARY}", f"/tmp/{CANARY}", "C:\\" + CANARY, f"..\\{CANARY}",
    f"~/{CANARY}", "/", "", ".", "..", "a\x00b", "x" * 60_000, "scene.json", "scene.npz", "SCENE.JSON", "\u202e", "con",
)  # fmt: skip
"""Names of an archive's members that lead out of any folder, or are none."""
LENGTHS = ("1", "0", "-1", "True", "1.5", "9" * 30, "9" * 5000, "None", "'a'", "2**62", "1,1", "0x10")
TYPES = (
    "'<f8'", "'|O'", "'<V100000000'", "'<U999999999'", "[('a', '<f8')]", "[]", "'<f8' * 9", "{}", "1", "'M8[x]'",
    "[('a', [('b', '<f8', (9, 9, 9))])]", "('<f8', (1000000,))",
)  # fmt: skip
CALLS = (
    b"posix\nsystem", b"builtins\neval", b"builtins\nopen", b"os\nmkdir", b"subprocess\ncheck_output",
    b"numpy.core.multiarray\n_reconstruct", b"numpy\nndarray", b"numpy\nload", b"pickle\nloads",
)  # fmt: skip
KINDS = tuple(bytes([kind]) for kind in b"0123456SLKxg")
SIZES = (b"\xff" * 12, b"7" * 12, b"-1" * 6, b"\x80" + b"\xff" * 11, b"\0" * 12)
WORDS = (b"\xff\xff", b"\x00\x00", b"\xff\x7f", b"\x01\x80")
VALUES: tuple[object, ...] = (
    None, True, -1, 0, 1e308, 10**400, -(10**30), float("nan"), float("inf"), "", "\x00", "\ud800", "x" * 100_000,
    [], {}, [1e9] * 5000, [[0, 1]] * 3000, {"a": {}}, {str(i): i for i in range(2000)}, "2**9", "0", [None],
    [float("nan")] * 3, "../" * 50,
)  # fmt: skip


def one(rng: np.random.Generator, things: Sequence[Thing]) -> Thing:
    """One of them."""
    return things[int(rng.integers(len(things)))]


def value(rng: np.random.Generator) -> object:
    """Something of JSON that is seldom expected; the caller's own, to write into."""
    deep: object = 0
    for _ in range(int(rng.choice([1, 50, 900]))):
        deep = [deep] if rng.random() < 0.5 else {"a": deep}
    chosen = one(rng, (*VALUES, deep))
    return chosen if chosen is deep else copy.deepcopy(chosen)


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """Cut short, or with bytes changed, put in, doubled or taken out."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if not out:
            break
        place, length = int(rng.integers(len(out))), int(10 ** rng.uniform(0, 2.5))
        match int(rng.integers(6)):
            case 0:
                out[place] ^= 1 << int(rng.integers(8))
            case 1:
                out[place : place + length] = rng.bytes(length)
            case 2:
                out[place:place] = out[place : place + length] * int(rng.integers(1, 50))
            case 3:
                del out[place : place + length]
            case 4:
                out[place : place + 4] = struct.pack(
                    "<L", int(rng.choice([0, 1, 2**31, 2**32 - 1, 0x7FFFFFFF]))
                )
            case _:
                if rng.random() < 0.3:
                    del out[place:]
    return bytes(out)
