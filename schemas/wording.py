"""Errors in words for people: the reason of an exception without its class, and the key that was probably meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from itertools import islice

CLOSE = 0.6
"""Similarity (``difflib``'s ratio) from which on another key is taken for the one that was meant."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr", ".mp4", ".mov", ".avi", ".mkv")
"""Endings of files that hold pictures or films."""
LOOKED_AT = 20_000


def reason(error: BaseException) -> str:
    """What an exception says, on one line and without the name of its class.

    An error of the system is its path and its words; a missing key is said to be missing; an exception without a
    text is the words of its class's name (``TimeoutError``: "timeout").
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, KeyError) and len(error.args) == 1:
        return f"there is no {error.args[0]!r}"
    text = " ".join(str(error).split())
    return text or words(type(error).__name__.removesuffix("Error").removesuffix("Exception") or "an error")


def roughly(seconds: float) -> str:
    """A time left, no more exact than an estimate is: ``a few seconds``, ``25 s``, ``4 min``, ``1 h 20 min``."""
    if seconds < 7.5:
        return "a few seconds"
    if seconds < 57.5:
        return f"{5 * round(seconds / 5)} s"
    minutes = max(1, round(seconds / 60))
    if minutes < 60:
        return f"{minutes} min"
    hours, rest = divmod(10 * round(minutes / 10), 60)
    return f"{hours} h {rest:02d} min" if rest else f"{hours} h"


def words(class_name: str) -> str:
    """``SceneInvalid`` as ``scene invalid``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", class_name).lower()


def pictures_among(names: Iterable[str], source: str) -> str:
    """A sentence that says how many pictures lie where a scene was expected, and what to do; empty without any.

    Args:
        names: of files; at most ``LOOKED_AT`` of them are looked at.
        source: what holds them, as a person gave it.
    """
    seen = [name for name in islice(names, LOOKED_AT) if name.lower().endswith(PICTURES)]
    if not seen:
        return ""
    first = min(seen).rpartition("/")[2]
    count = "a picture was" if len(seen) == 1 else f"{len(seen)} pictures were"
    return (
        f"{count} seen ({first}{', ...' if len(seen) > 1 else ''}): "
        f"`physworld import {source} --out SCENE` makes a scene of pictures with depth"
    )


def meant(given: str, known: Iterable[str], what: str = "key") -> str:
    """``unknown key; did you mean 'episodes'?``, or all that are known where none is close.

    Args:
        given: what nobody knows.
        known: what it could be.
        what: it is.
    """
    allowed = sorted(known)
    close = difflib.get_close_matches(given, allowed, n=1, cutoff=CLOSE)
    if close:
        return f"unknown {what}; did you mean {close[0]!r}?"
    return f"unknown {what}; known are {', '.join(map(repr, allowed))}" if allowed else f"unknown {what}"
