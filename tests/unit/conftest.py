"""Arrays that a test makes for a kernel lie where the library's lie."""

from __future__ import annotations

import pytest
import warp as wp

from physworld.devices import default_device


@pytest.fixture(scope="session", autouse=True)
def _one_device() -> None:
    wp.init()
    wp.set_device(default_device())
