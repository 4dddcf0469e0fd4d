"""The study's network that mixes along the modes of its graph."""

from __future__ import annotations

import pytest
from held_bar import SMALL, episode, graph

from benchmarks.worldmodel.spectral import SpectralModel, spectral
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow


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
