"""The bar's episodes, simulated once."""

from __future__ import annotations

import numpy as np
import pytest
from held_bar import SMALL, episode, graph

from physworld.worldmodel.dataset import Track, read_track


@pytest.fixture(scope="session")
def episodes() -> list[dict[str, np.ndarray]]:
    return [episode(seed) for seed in range(16)]


@pytest.fixture(scope="session")
def tracks(episodes: list[dict[str, np.ndarray]]) -> list[Track]:
    spec = graph()
    return [read_track(spec, arrays, SMALL.history) for arrays in episodes]
