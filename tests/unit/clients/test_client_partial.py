"""A download is resumed from what is there and seen only whole."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from physworld_client import Client
from physworld_client.errors import DigestMismatch, PhysWorldError
from physworld_client.partial import PartialFile

DATA = b"0123456789"
DIGEST = hashlib.sha256(DATA).hexdigest()


def answer(status: int, **headers: str) -> httpx.Response:
    request = httpx.Request("GET", "http://localhost/v1/artifacts/x")
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.Response(status, headers=named, request=request)


def left(target: Path, data: bytes) -> None:
    """What a download that broke off leaves."""
    with PartialFile(target, DIGEST) as partial:
        partial.write(data)


def test_a_new_download_asks_for_everything_and_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "sub" / "file"
    with PartialFile(target, DIGEST) as partial:
        assert "Range" not in partial.headers()
        partial.accept(answer(200))
        partial.write(DATA[:4])
        partial.write(DATA[4:])
        assert not target.exists()
        assert partial.finish() == target
    assert target.read_bytes() == DATA
    assert [path.name for path in target.parent.iterdir()] == ["file"]


def test_a_broken_download_is_continued(tmp_path: Path) -> None:
    left(tmp_path / "file", DATA[:4])
    with PartialFile(tmp_path / "file", DIGEST) as partial:
        assert partial.headers()["Range"] == "bytes=4-"
        partial.accept(answer(206, content_range="bytes 4-9/10"))
        partial.write(DATA[4:])
        assert partial.finish().read_bytes() == DATA


def test_a_service_that_ignores_the_range_starts_over(tmp_path: Path) -> None:
    left(tmp_path / "file", DATA[:4])
    with PartialFile(tmp_path / "file", DIGEST) as partial:
        partial.accept(answer(200))
        partial.write(DATA)
        assert partial.finish().read_bytes() == DATA


def test_another_range_than_asked_is_refused(tmp_path: Path) -> None:
    left(tmp_path / "file", DATA[:4])
    with (
        PartialFile(tmp_path / "file", DIGEST) as partial,
        pytest.raises(PhysWorldError, match="asked from byte 4"),
    ):
        partial.accept(answer(206, content_range="bytes 3-9/10"))


def test_a_part_that_is_too_long_is_dropped(tmp_path: Path) -> None:
    left(tmp_path / "file", DATA + b"!")
    with PartialFile(tmp_path / "file", DIGEST) as partial:
        assert partial.refused(answer(416))
        assert partial.headers().get("Range") is None
        assert not partial.refused(answer(416)), "with nothing to drop the refusal is an error"


def test_a_part_that_is_whole_needs_no_request(tmp_path: Path) -> None:
    left(tmp_path / "file", DATA)
    with PartialFile(tmp_path / "file", DIGEST) as partial:
        assert partial.complete()
        assert partial.finish().read_bytes() == DATA


def test_wrong_bytes_leave_nothing_behind(tmp_path: Path) -> None:
    with PartialFile(tmp_path / "file", DIGEST) as partial:
        partial.write(b"012345678X")
        with pytest.raises(DigestMismatch, match=DIGEST):
            partial.finish()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_artifact_is_a_file_too(tmp_path: Path) -> None:
    with PartialFile(tmp_path / "file", hashlib.sha256(b"").hexdigest()) as partial:
        assert partial.finish().read_bytes() == b""


def test_a_download_that_got_nothing_leaves_no_part(tmp_path: Path) -> None:
    with PartialFile(tmp_path / "file", DIGEST):
        pass
    assert list(tmp_path.iterdir()) == []


def test_two_downloads_of_one_file_do_not_mix_their_bytes(tmp_path: Path) -> None:
    target = tmp_path / "file"
    left(target, DATA[:4])
    with PartialFile(target, DIGEST) as first, PartialFile(target, DIGEST) as second:
        assert (first.offset, second.offset) == (4, 0), "the part that is there belongs to the first"
        second.write(DATA[:6])
        first.write(DATA[4:])
        assert first.finish().read_bytes() == DATA
        second.write(DATA[6:])
        assert second.finish().read_bytes() == DATA
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_parts_that_nobody_writes_any_more_go_with_the_first_that_finishes(tmp_path: Path) -> None:
    target = tmp_path / "file"
    with PartialFile(target, DIGEST) as first, PartialFile(target, DIGEST) as second:
        first.write(DATA[:2])
        second.write(DATA[:5])
    assert len(list(tmp_path.iterdir())) == 2
    with PartialFile(target, DIGEST) as again:
        again.write(DATA[again.offset :])
        again.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_eight_downloads_at_once_all_succeed(tmp_path: Path) -> None:
    """Through the client, in threads: the service sends small pieces, so that they overlap."""
    data = bytes(range(256)) * 64
    digest = hashlib.sha256(data).hexdigest()

    class Slowly(httpx.SyncByteStream):
        def __init__(self, start: int) -> None:
            self.start = start

        def __iter__(self) -> Iterator[bytes]:
            for at in range(self.start, len(data), 2048):
                time.sleep(0.002)
                yield data[at : at + 2048]

    def serve(request: httpx.Request) -> httpx.Response:
        start = int(request.headers.get("range", "bytes=0-")[6:-1])
        if not start:
            return httpx.Response(200, stream=Slowly(0))
        place = f"bytes {start}-{len(data) - 1}/{len(data)}"
        return httpx.Response(206, headers={"content-range": place}, stream=Slowly(start))

    def download(_: int) -> bytes:
        with Client("http://127.0.0.1:1", transport=httpx.MockTransport(serve)) as client:
            return client.artifacts.download(digest, tmp_path / "file").read_bytes()

    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(download, range(8))) == {data}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_is_no_digest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PhysWorldError, match="not a SHA-256"):
        PartialFile(tmp_path / "file", "../../etc/passwd")
