"""A download is resumed from what is there and seen only whole."""

from __future__ import annotations

import hashlib
from pathlib import Path

import httpx
import pytest
from physworld_client.errors import DigestMismatch, PhysWorldError
from physworld_client.partial import PartialFile

DATA = b"0123456789"
DIGEST = hashlib.sha256(DATA).hexdigest()


def answer(status: int, **headers: str) -> httpx.Response:
    request = httpx.Request("GET", "http://localhost/v1/artifacts/x")
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.Response(status, headers=named, request=request)


def test_a_new_download_asks_for_everything_and_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "sub" / "file"
    partial = PartialFile(target, DIGEST)
    assert "Range" not in partial.headers()
    partial.accept(answer(200))
    partial.write(DATA[:4])
    partial.write(DATA[4:])
    assert not target.exists()
    assert partial.finish() == target
    assert target.read_bytes() == DATA
    assert [path.name for path in target.parent.iterdir()] == ["file"]


def test_a_broken_download_is_continued(tmp_path: Path) -> None:
    PartialFile(tmp_path / "file", DIGEST).write(DATA[:4])
    partial = PartialFile(tmp_path / "file", DIGEST)
    assert partial.headers()["Range"] == "bytes=4-"
    partial.accept(answer(206, content_range="bytes 4-9/10"))
    partial.write(DATA[4:])
    assert partial.finish().read_bytes() == DATA


def test_a_service_that_ignores_the_range_starts_over(tmp_path: Path) -> None:
    PartialFile(tmp_path / "file", DIGEST).write(DATA[:4])
    partial = PartialFile(tmp_path / "file", DIGEST)
    partial.accept(answer(200))
    partial.write(DATA)
    assert partial.finish().read_bytes() == DATA


def test_another_range_than_asked_is_refused(tmp_path: Path) -> None:
    PartialFile(tmp_path / "file", DIGEST).write(DATA[:4])
    partial = PartialFile(tmp_path / "file", DIGEST)
    with pytest.raises(PhysWorldError, match="asked from byte 4"):
        partial.accept(answer(206, content_range="bytes 3-9/10"))


def test_a_part_that_is_too_long_is_dropped(tmp_path: Path) -> None:
    PartialFile(tmp_path / "file", DIGEST).write(DATA + b"!")
    partial = PartialFile(tmp_path / "file", DIGEST)
    assert partial.refused(answer(416))
    assert partial.headers().get("Range") is None
    assert not partial.refused(answer(416)), "with nothing to drop the refusal is an error"


def test_a_part_that_is_whole_needs_no_request(tmp_path: Path) -> None:
    PartialFile(tmp_path / "file", DIGEST).write(DATA)
    partial = PartialFile(tmp_path / "file", DIGEST)
    assert partial.complete()
    assert partial.finish().read_bytes() == DATA


def test_wrong_bytes_leave_nothing_behind(tmp_path: Path) -> None:
    partial = PartialFile(tmp_path / "file", DIGEST)
    partial.write(b"012345678X")
    with pytest.raises(DigestMismatch, match=DIGEST):
        partial.finish()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_artifact_is_a_file_too(tmp_path: Path) -> None:
    partial = PartialFile(tmp_path / "file", hashlib.sha256(b"").hexdigest())
    assert partial.finish().read_bytes() == b""


def test_what_is_no_digest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PhysWorldError, match="not a SHA-256"):
        PartialFile(tmp_path / "file", "../../etc/passwd")
