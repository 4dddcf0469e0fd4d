"""Batches of candidates and live sessions are the single rollout, over again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.live import LiveRollout
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.skinning import affine_skin
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.rollout import rollout, unroll

SINGLE_PRECISION_M = 2e-6  # over 12 steps, of a body of 0.16 m
CANDIDATES, FRAMES = 5, 15


def published(*, trained: bool = True, ground: float | None = None) -> PublishedModel:
    spec = graph(dataclasses.replace(SMALL, hidden=24), ground)
    torch.manual_seed(0)
    model = WorldModel(dataclasses.replace(SMALL, hidden=24), spec, Normalisation(3e-3, 1e-3))
    if trained:
        with torch.no_grad():
            for parameter in (model.skip.weight, model.decoder.out.weight):
                parameter.normal_(0.0, 0.2)
            model.prior.response.normal_(0.0, 0.01)
            model.prior.span.copy_(torch.tensor([-0.1, 0.1]))
    rest = spec.rest_vertices
    controls = rest[spec.neighbours[spec.object_count :, 0]]
    frames = SMALL.history + 1
    return PublishedModel(
        model=model,
        phi=np.zeros((spec.object_count, 2)),
        phi_calibrated=np.zeros((spec.object_count, 2)),
        start_history=np.repeat(rest[None], frames, axis=0),
        start_controllers=np.repeat(controls[None], frames, axis=0),
        start_time_s=0.0,
        skin=affine_skin(rest, rest),
    )


def candidates(model: PublishedModel, count: int = CANDIDATES) -> np.ndarray:
    """Control paths (B, T, K, 3) that share their first frames and then part."""
    rng = np.random.default_rng(4)
    frames = len(model.start_controllers)
    path = np.repeat(model.start_controllers[-1:], FRAMES, axis=0)
    walks = rng.normal(0.0, 4e-3, (count, FRAMES - frames, 1, 3)).cumsum(axis=1)
    batch = np.repeat(path[None], count, axis=0)
    batch[:, frames:] += walks
    return batch


@pytest.mark.parametrize(
    ("trained", "ground", "threads"), [(True, None, 1), (True, -0.1, 3), (False, None, 2)]
)
def test_a_batch_is_its_single_rollouts(trained: bool, ground: float | None, threads: int) -> None:
    model = published(trained=trained, ground=ground)
    driven = candidates(model)
    phi = np.random.default_rng(1).normal(0.0, 0.2, (CANDIDATES, *model.phi.shape))
    together = model.rollout_batch(driven, phi=phi, threads=threads)
    alone = [
        rollout(model.model, model.spec, model.start_history, path, properties)
        for path, properties in zip(driven, phi, strict=True)
    ]
    assert np.abs(together[0] - together[1]).max() > 1e-3
    assert np.array_equal(together, np.array(alone))


@pytest.mark.parametrize("trained", [True, False])
def test_a_batch_is_the_batch_of_torch(trained: bool) -> None:
    model = published(trained=trained)
    n, frames = model.spec.object_count, len(model.start_history)
    driven = candidates(model)
    start = torch.as_tensor(model.start_history, dtype=torch.float32)[:, :, None].expand(
        -1, -1, CANDIDATES, -1
    )
    moving = torch.as_tensor(driven[:, :, model.spec.control_index], dtype=torch.float32).permute(1, 2, 0, 3)
    expected = unroll(model.model, start, moving, torch.zeros(n, CANDIDATES, 2))[:, :n]
    got = model.rollout_batch(driven)
    assert np.abs(got[:, frames:] - got[:, frames - 1 : frames]).max() > 5e-3
    assert got == pytest.approx(expected.permute(2, 0, 1, 3).numpy(), abs=SINGLE_PRECISION_M)


def test_an_untrained_network_leaves_the_prior_as_it_is() -> None:
    assert published(trained=True).model.corrects_prior()
    assert not published(trained=False).model.corrects_prior()


def test_a_session_is_the_rollout_cut_into_steps() -> None:
    model = published()
    driven = candidates(model, 1)[0]
    whole = model.rollout(driven)
    session = LiveRollout(model)
    for _ in range(2):  # a reset starts over
        stepped = [session.step(places) for places in driven[len(model.start_history) :]]
        assert np.array_equal(np.array(stepped), whole[len(model.start_history) :])
        assert session.tick == len(stepped)
        session.reset()
    assert np.abs(session.vertices - model.start_history[-1]).max() < SINGLE_PRECISION_M


def test_a_session_refuses_what_is_no_place_and_does_not_move() -> None:
    session = LiveRollout(published())
    before = session.vertices
    for wrong in (session.controllers[:-1], np.full(session.controllers.shape, np.nan)):
        with pytest.raises(GraphInvalid, match="finite"):
            session.step(wrong)
    assert session.tick == 0
    assert np.array_equal(session.vertices, before)


def test_a_batch_of_other_shapes_is_refused() -> None:
    model = published()
    with pytest.raises(GraphInvalid, match="do not drive"):
        model.rollout_batch(candidates(model)[:, :, :1])
    with pytest.raises(GraphInvalid, match="phi"):
        model.rollout_batch(candidates(model), phi=model.phi[:-1])


def test_values_that_are_no_numbers_are_refused() -> None:
    """The engine would hand them on into every vertex."""
    model = published()
    spoilt = candidates(model)
    spoilt[1, 4, 0, 2] = np.nan
    with pytest.raises(GraphInvalid, match="1 values of controllers, history and phi are not finite"):
        model.rollout_batch(spoilt)
    with pytest.raises(GraphInvalid, match="1 values"):
        model.rollout(spoilt[1])
    with pytest.raises(GraphInvalid, match=f"{model.phi.size} values"):
        model.rollout_batch(candidates(model), phi=np.full_like(model.phi, np.inf))
