"""Byte ranges and conditional requests of immutable files (RFC 9110 sections 13 and 14, RFC 9530 digests)."""

from __future__ import annotations

import base64
import re

from physworld_services.api.errors import ApiProblem

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.ASCII)  # more digits than any file has bytes


def parse_range(header: str | None, size: int) -> tuple[int, int] | None:
    """The half-open byte range [start, end) that the client asks of a file of ``size`` bytes.

    None: send the whole file, because no range was asked, or one of a form that a server may ignore (another
    unit, several ranges, digits missing or too many). Raises the 416 problem for a range that starts past the end.
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None or match.group(1) == match.group(2) == "":
        return None
    first, last = match.groups()
    if first == "":
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < start:
            return None
    if start >= size:
        raise ApiProblem(
            416,
            "range_not_satisfiable",
            f"{header} of a file of {size} bytes",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end


def etag(sha256: str) -> str:
    """The strong entity tag of a content-addressed file."""
    return f'"{sha256}"'


def tag_matches(header: str | None, sha256: str) -> bool:
    """Whether an If-None-Match (or If-Range) header names this file; weak comparison (RFC 9110, 13.1.2)."""
    if header is None:
        return False
    tags = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    return "*" in tags or etag(sha256) in tags


def digest_field(sha256: str) -> str:
    """The value of Content-Digest and Repr-Digest: the SHA-256 as a structured-field byte sequence."""
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"
