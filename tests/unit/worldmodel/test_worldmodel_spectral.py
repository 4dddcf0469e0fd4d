"""The study's network that mixes along the modes of its graph."""

from __future__ import annotations

import numpy as np
import pytest
from held_bar import SMALL, episode, graph

from benchmarks.worldmodel.spectral import SpectralModel, graph_modes, spectral
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow


def test_modes_of_the_graph_are_orthogonal_and_the_first_is_the_whole_body() -> None:
    rest = np.random.default_rng(1).uniform(size=(20, 3))
    modes = graph_modes(rest, 8)
    assert modes.T @ modes / len(rest) == pytest.approx(np.eye(8), abs=1e-9)
    assert np.abs(modes[:, 0]) == pytest.approx(np.ones(20))


@pytest.mark.parametrize("framed", [False, True])
def test_it_begins_as_its_prior_and_learns_by_its_modes(framed: bool) -> None:
    spec = graph(framed=framed)
    tracks = [read_track(spec, episode(seed), SMALL.history) for seed in range(3)]
    settings = TrainingConfig(
        steps=2, batch_size=2, look_ahead=2, validation_every=1, prior="modal", frame="grip"
    )
    result = train(tracks, spec, SMALL, settings, network=spectral(tracks))
    model = result.model
    assert isinstance(model, SpectralModel) and result.steps_left_out == 0
    assert result.validation[0][1] == pytest.approx(result.prior_errors_m[result.prior], rel=1e-3)
    assert result.validation[-1][1] != train(tracks, spec, SMALL, settings).validation[-1][1]
