"""Whether the interpreter has the fixes that reading strangers' files asks for."""

from __future__ import annotations

import sys

FIXED_IN = {(3, 11): 10, (3, 12): 6, (3, 13): 0}
"""Patch releases from which on tarfile parses long PAX headers in linear time (CVE-2024-6232), by minor version."""


def warning(version: tuple[int, int, int] = sys.version_info[:3]) -> str | None:
    """A sentence for whoever starts the service, or None. Distributions port fixes back, so it is no refusal.

    Uploads are safe without the fix too: long headers are refused before tarfile sees them
    (``physworld_scenes.archives``), and what reads them may take some seconds of processor time only.
    """
    fixed = FIXED_IN.get(version[:2])
    if fixed is None or version[2] >= fixed:
        return None
    now, then = ".".join(map(str, version)), ".".join(map(str, (*version[:2], fixed)))
    return (
        f"Python {now} is older than {then}: unless your distribution has ported the fixes back, it lacks that of "
        "CVE-2024-6232 (tarfile) and later ones; update the interpreter"
    )
