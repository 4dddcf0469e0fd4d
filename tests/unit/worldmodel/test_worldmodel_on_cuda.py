"""The network learns on a GPU what it learns on a CPU."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, episode, graph

from physworld.worldmodel.dataset import Track, WindowSampler, read_track
from physworld.worldmodel.errors import TrainingCancelled
from physworld.worldmodel.loss import GraphedLoss, plain_loss
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.training import train

SETTINGS = TrainingConfig(
    steps=30, batch_size=4, look_ahead=8, validation_every=10, checkpoint_every=10, validation_fraction=0.2
)


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return [read_track(graph(), episode(seed), SMALL.history) for seed in range(8)]


def network(device: str) -> WorldModel:
    torch.manual_seed(0)
    model = WorldModel(SMALL, graph())
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.01)
        model.decoder.out.weight.normal_(0.0, 0.01)
    return model.to(device)


def gradient(model: WorldModel) -> torch.Tensor:
    return torch.cat([parameter.grad.reshape(-1).cpu() for parameter in model.parameters()])


def test_the_recorded_loss_and_its_gradient_are_those_of_the_cpu(tracks: list[Track], gpu: str) -> None:
    h = SMALL.history
    batches = [
        WindowSampler(tracks).draw(h + 6, count, torch.Generator().manual_seed(seed))
        for seed, count in ((0, 4), (1, 4), (2, 3))
    ]
    here, there, recorded = network("cpu"), network(gpu), GraphedLoss()
    assert GraphedLoss.fits(there) and not GraphedLoss.fits(here)
    for batch in batches:  # the third has another size: recorded anew
        parts = batch.positions[: h + 1], batch.positions[h + 1 :], batch.phi
        expected, found = plain_loss(here, *parts).item(), recorded(there, *parts).item()
        assert found == pytest.approx(expected, rel=1e-4)
        scale = gradient(here).abs().max()
        assert torch.allclose(gradient(there), gradient(here), atol=2e-4 * float(scale))


@pytest.mark.parametrize("settings", [{}, {"frame": "grip"}, {"prior": "none"}])
def test_a_training_ends_where_it_ends_on_a_cpu(
    settings: dict[str, str], tracks: list[Track], gpu: str
) -> None:
    spec = graph(framed="frame" in settings)
    given = dataclasses.replace(SETTINGS, **settings)
    here = train(tracks, spec, SMALL, given)
    there = train(tracks, spec, SMALL, given, device=gpu)
    assert next(there.model.parameters()).device.type == "cpu"
    assert there.best_error_m == pytest.approx(here.best_error_m, rel=0.05)
    assert np.allclose([e for _, e in there.validation], [e for _, e in here.validation], rtol=0.05)


def test_near_edges_of_the_current_shape_train_too(tracks: list[Track], gpu: str) -> None:
    config = dataclasses.replace(SMALL, near_edges="current")
    given = dataclasses.replace(SETTINGS, steps=5, validation_every=5)
    here, there = (train(tracks, graph(config), config, given, device=device) for device in ("cpu", gpu))
    assert there.best_error_m == pytest.approx(here.best_error_m, rel=0.05)


def test_a_training_goes_on_from_a_checkpoint_of_either_device(tracks: list[Track], gpu: str) -> None:
    whole = train(tracks, graph(), SMALL, SETTINGS)
    saved: list[bytes] = []
    with pytest.raises(TrainingCancelled):
        train(tracks, graph(), SMALL, SETTINGS, device=gpu, save_checkpoint=saved.append,
              cancelled=lambda: bool(saved))  # fmt: skip
    for device in ("cpu", gpu):
        resumed = train(tracks, graph(), SMALL, SETTINGS, device=device, checkpoint=saved[0])
        assert resumed.best_error_m == pytest.approx(whole.best_error_m, rel=0.05)
