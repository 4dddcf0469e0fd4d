"""What the dashboard keeps of recordings and pictures is bounded by its bytes."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from physworld_services.dashboard import site as site_module
from physworld_services.dashboard.byte_cache import ByteCache, size_of
from physworld_services.dashboard.site import Site
from physworld_services.stores import Stores
from physworld_storage.database import open_database
from physworld_storage.settings import Settings

KILOBYTE = 1024


@dataclass(frozen=True)
class Recording:
    points: np.ndarray
    declared: dict[str, list[float]]


def test_a_size_counts_the_arrays_inside() -> None:
    points = np.zeros((1000, 3))
    assert size_of(points) == points.nbytes
    assert size_of({"a": points, "b": points}) >= 2 * points.nbytes
    assert size_of(Recording(points, {"x": [1.5] * 1000})) >= points.nbytes + 8 * 1000


def test_what_was_not_used_for_longest_goes_first() -> None:
    cache = ByteCache(3 * KILOBYTE)
    made: list[str] = []

    def of(name: str) -> np.ndarray:
        def make() -> np.ndarray:
            made.append(name)
            return np.zeros(KILOBYTE, dtype=np.uint8)

        return cache.get(name, make)

    for name in "abcabda":
        of(name)
    assert made == ["a", "b", "c", "d"], "c made room for d"
    assert cache.bytes == 3 * KILOBYTE
    of("c")
    assert made[-1] == "c" and cache.bytes <= cache.limit


def test_one_that_is_too_large_is_given_and_not_kept() -> None:
    cache = ByteCache(KILOBYTE)
    cache.get("small", lambda: np.zeros(KILOBYTE, dtype=np.uint8))
    assert len(cache.get("large", lambda: np.zeros(2 * KILOBYTE, dtype=np.uint8))) == 2 * KILOBYTE
    assert cache.bytes == KILOBYTE
    with pytest.raises(ValueError, match="no"):
        cache.get("broken", lambda: int("no"))


def test_the_pictures_of_a_site_stay_below_its_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight of them were kept before, however large they were."""
    monkeypatch.setattr(site_module, "CACHED_BYTES", 40 * KILOBYTE)
    settings = Settings(data_dir=tmp_path)
    stores = Stores(settings)
    database = open_database(settings)
    site = Site(settings, database, stores)
    for number in range(6):
        buffer = io.BytesIO()
        np.savez(buffer, points=np.full((10 * KILOBYTE,), number, dtype=np.uint8))
        artifact = stores.artifacts.put_bytes(buffer.getvalue(), "prediction.npz")
        arrays = site.arrays([artifact], "prediction.npz")
        assert arrays is not None and (arrays["points"] == number).all()
    assert 20 * KILOBYTE < site._parsed.bytes <= 40 * KILOBYTE
    database.dispose()
