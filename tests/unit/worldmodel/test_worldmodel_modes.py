"""The linear map of modes beside the messages: its shapes, its bound, when there is one, how it is published."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hanging_rope
import held_bar
import numpy as np
import pytest
import torch

from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.modes import BOUND, ModalMap, graph_modes, measure_modes
from physworld.worldmodel.model.skinning import affine_skin
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

SPEC, H = hanging_rope.graph(), hanging_rope.SMALL.history
LITTLE = TrainingConfig(steps=3, batch_size=2, look_ahead=4, validation_every=1)


def rope_tracks(count: int) -> list[Track]:
    return [read_track(SPEC, hanging_rope.episode(seed), H) for seed in range(count)]


def mapped() -> ModalMap:
    """A map with weights, of the rope."""
    torch.manual_seed(2)
    made = ModalMap(measure_modes([track.positions for track in rope_tracks(2)], SPEC, H))
    with torch.no_grad():
        made.weight.normal_(0.0, 0.1)
    return made


def test_modes_of_the_graph_are_orthogonal_and_the_first_is_the_whole_body() -> None:
    rest = np.random.default_rng(1).uniform(size=(20, 3))
    shapes = graph_modes(rest, 8)
    assert shapes @ shapes.T / len(rest) == pytest.approx(np.eye(8), abs=1e-9)
    assert np.abs(shapes[0]) == pytest.approx(np.ones(20))
    assert graph_modes(rest[:5]).shape == (5, 5)


def test_what_the_map_adds_is_bounded_and_the_same_anywhere() -> None:
    """Where everything moves with the grips nothing changes; far outside of what was shown it does not grow."""
    made, path = mapped(), rope_tracks(1)[0].positions
    window, ahead = path[: H + 1, :, None], path[H + 1, :, None]
    with torch.no_grad():
        added = made(window, ahead)
        shifted = made(window + torch.tensor([3.0, -2.0, 1.0]), ahead + torch.tensor([3.0, -2.0, 1.0]))
        far, farther = (made(window * size, ahead * size) for size in (1e4, 1e7))
    assert added.shape == (SPEC.object_count, 1, 3) and float(added.abs().max()) > 1e-5
    assert torch.allclose(added, shifted, atol=1e-3 * float(added.abs().max()) + 1e-5)
    reach = made.weight.detach().abs().sum(dim=0).reshape(-1, 3)
    most = BOUND * made.shapes.abs().T @ (made.change[:, None] * reach)
    assert bool((far.abs()[:, 0] <= most * (1.0 + 1e-5)).all())
    assert torch.allclose(far, farther, atol=0.2 * float(most.max()))


def test_ropes_and_networks_alone_have_one_and_bodies_on_a_modal_prior_none() -> None:
    rope = train(rope_tracks(3), SPEC, hanging_rope.SMALL, replace(LITTLE, prior="chain")).model
    assert rope.modes is not None
    bar = held_bar.graph(held_bar.SMALL, None)
    tracks = [read_track(bar, held_bar.episode(seed), held_bar.SMALL.history) for seed in range(3)]
    assert train(tracks, bar, held_bar.SMALL, replace(LITTLE, prior="modal")).model.modes is None
    alone = train(tracks, bar, held_bar.SMALL, replace(LITTLE, steps=1, prior="none")).model
    assert alone.modes is not None


def test_another_body_goes_on_from_the_network_and_not_from_the_map() -> None:
    one, other = (WorldModel(hanging_rope.SMALL, SPEC, modes=measured()) for _ in range(2))
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.fill_(0.5)
    one.take(other)
    assert one.modes is not None and not bool(one.modes.weight.any())
    assert bool((one.skip.weight == 0.5).all())
    assert not WorldModel(hanging_rope.SMALL, SPEC, modes=measured()).corrects_prior()


def measured() -> Any:
    return measure_modes([track.positions for track in rope_tracks(1)], SPEC, H)


def published() -> PublishedModel:
    n, path = SPEC.object_count, rope_tracks(1)[0].positions.numpy().astype(float)
    model = WorldModel(hanging_rope.SMALL, SPEC, modes=measured())
    assert model.modes is not None
    with torch.no_grad():
        model.modes.weight.normal_(0.0, 0.05)
    return PublishedModel(
        model=model,
        phi=np.zeros((n, 2)),
        phi_calibrated=np.zeros((n, 2)),
        start_history=path[: H + 1, :n],
        start_controllers=path[: H + 1, n:],
        start_time_s=0.0,
        skin=affine_skin(path[0, :n], path[0, :n]),
    )


def test_it_is_published_so_that_an_older_reader_does_not_leave_it_out() -> None:
    version = published()
    tensors, facts = version.to_tensors(), version.facts()
    assert "skip.weight" not in tensors and facts["mapped_modes"] == len(tensors["modes.shapes"]) == 16
    again = PublishedModel.from_tensors(tensors, facts)
    controllers = np.repeat(version.start_controllers[-1:], 12, axis=0)
    assert np.array_equal(again.rollout(controllers), version.rollout(controllers))
    assert len(again.to_tensors()) == len(tensors)
    for name, broken in (
        ("modes.weight", tensors["modes.weight"][:-3]),
        ("modes.scale", np.full_like(tensors["modes.scale"], np.nan)),
    ):
        with pytest.raises(VersionUnreadable, match=name):
            PublishedModel.from_tensors(tensors | {name: broken}, facts)
