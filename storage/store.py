"""The object store behind artifacts and episodes: a local folder or a bucket, and its errors as ours.

A missing object is NotFound; a write that failed is StoreWriteFailed or, for want of space, StoreFull; any
other failure to read is StoreReadFailed. Open stores in the process that uses them, after a fork.

A request to a bucket ends when no byte of its answer has come for ``Patience.store_silence_s``. What is limited is
the silence and not the whole, so that a download of some GiB takes as long as it takes; an upload goes in parts of
5 MiB, of which each has this time. While the bucket is known to be silent, ``reading`` and ``writing`` raise at once.
"""

from __future__ import annotations

import errno
import functools
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any
from urllib.parse import urlsplit

from obstore.exceptions import BaseError, NotFoundError
from obstore.store import LocalStore, S3Store

from physworld_storage.errors import (
    ConfigurationError,
    NotFound,
    StoreFull,
    StoreReadFailed,
    StoreWriteFailed,
)
from physworld_storage.patience import WORKING, Patience, Silence
from physworld_storage.settings import STORE_SCHEMES, Settings

WHOLE_REQUEST = timedelta(days=1)
"""Of one request with its body, however slowly it gets on."""
MAX_RETRIES = 5
TRIAL_S = 10.0
SILENT_WORDS = ("timed out", "timeout", "TimedOut", "Timeout")

FULL_ERRNO = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
FULL_WORDS = (
    *(f"(os error {number})" for number in sorted(FULL_ERRNO)),
    "InsufficientStorage",
    "507 Insufficient Storage",
    "QuotaExceeded",
    "StorageFull",
)

Store = LocalStore | S3Store


def open_store(
    settings: Settings, below: str = "", patience: Patience = WORKING, *, uploads: bool = False
) -> Store:
    """The store that ``settings.store_url`` names, or what lies ``below`` a path in it.

    Args:
        settings: ``store_url`` names a folder or a bucket, the rest the bucket's credentials.
        below: path inside it.
        patience: how long connecting and silence may last.
        uploads: it is for putting objects: there sending counts as silence, so each part has
            ``Patience.store_upload_s``.

    Raises:
        ConfigurationError: the URL is of no known kind.
        StoreWriteFailed: the local folder cannot be made.
    """
    if settings.store_folder is not None:
        folder = settings.store_folder / below
        with writing(f"the folder {folder}", 0, settings):
            if (
                settings.data_dir in folder.parents
            ):  # parents that are made on the way would be readable by all
                settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            return LocalStore(folder, automatic_cleanup=True)
    url = urlsplit(settings.store_url)
    if url.scheme != "s3":
        raise ConfigurationError([f"store URL {settings.store_url!r}: known are {', '.join(STORE_SCHEMES)}"])
    secret = settings.s3_secret_access_key
    given: dict[str, Any] = {
        "endpoint": settings.s3_endpoint,
        "access_key_id": settings.s3_access_key_id,
        "secret_access_key": None if secret is None else secret.get_secret_value(),
    }
    plain = (settings.s3_endpoint or "").startswith("http://")
    return S3Store(
        url.netloc,
        prefix="/".join(part for part in (url.path.strip("/"), below) if part) or None,
        region=settings.s3_region,
        client_options={
            "connect_timeout": timedelta(seconds=patience.connect_s),
            "read_timeout": timedelta(
                seconds=patience.store_upload_s if uploads else patience.store_silence_s
            ),
            "timeout": WHOLE_REQUEST,
            "allow_http": plain,
        },
        retry_config={
            "max_retries": MAX_RETRIES,
            "retry_timeout": timedelta(seconds=patience.store_retry_s),
        },
        **{name: value for name, value in given.items() if value},
    )


@contextmanager
def writing(what: str, size: int, settings: Settings) -> Iterator[None]:
    """Errors of writing ``what`` (``size`` bytes) become StoreFull or StoreWriteFailed."""
    silent_s, asked_at = _silence_of(settings.store_url).silent_s(), time.monotonic()
    if silent_s is not None:
        raise StoreWriteFailed(f"{what}, {size} bytes, was not written: {_known(silent_s)}", _known(silent_s))
    try:
        yield
        _silence_of(settings.store_url).heard()
    except (OSError, BaseError) as error:
        told = _listen(error, settings, asked_at)
        reason = f"{what}, {size} bytes, was not written to {settings.store_url}: {_first_line(error)}"
        full = error.errno in FULL_ERRNO if isinstance(error, OSError) else False
        if full or any(word in str(error) for word in FULL_WORDS):
            raise StoreFull(f"{reason}{_free_bytes(settings)}") from error
        raise StoreWriteFailed(reason, told) from error


@contextmanager
def reading(kind: str, identifier: str, settings: Settings) -> Iterator[None]:
    """Errors of reading an object become NotFound or StoreReadFailed."""
    silent_s, asked_at = _silence_of(settings.store_url).silent_s(), time.monotonic()
    if silent_s is not None:
        raise StoreReadFailed(f"{kind} {identifier} was not read: {_known(silent_s)}", _known(silent_s))
    try:
        yield
        _silence_of(settings.store_url).heard()
    except (FileNotFoundError, NotFoundError) as error:
        _silence_of(settings.store_url).heard()
        raise NotFound(kind, identifier) from error
    except (OSError, BaseError) as error:
        told = _listen(error, settings, asked_at)
        reason = f"{kind} {identifier} cannot be read from {settings.store_url}: {_first_line(error)}"
        raise StoreReadFailed(reason, told) from error


@functools.lru_cache(maxsize=16)
def _silence_of(_store_url: str) -> Silence:
    return Silence(TRIAL_S)


def _known(silent_s: float) -> str:
    return f"the object store has not answered for {silent_s:.1f} s"


def _listen(error: Exception, settings: Settings, asked_at: float) -> str:
    """Remember whether the store was silent; what anybody may be told of the error."""
    if any(word in str(error) for word in SILENT_WORDS):
        _silence_of(settings.store_url).gave_up(asked_at)
        return "the object store did not answer in time"
    return "the object store cannot be reached or refuses to work"


def _free_bytes(settings: Settings) -> str:
    folder = settings.store_folder
    if folder is None or not folder.is_dir():
        return ""
    return f" ({shutil.disk_usage(folder).free} bytes are free)"


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
