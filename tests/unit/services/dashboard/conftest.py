"""An empty dashboard that these tests look at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from dashboard_served import Served, served


@pytest.fixture
def dashboard(tmp_path: Path) -> Iterator[Served]:
    """Somebody who may write is logged in."""
    with served(tmp_path) as dashboard:
        yield dashboard
