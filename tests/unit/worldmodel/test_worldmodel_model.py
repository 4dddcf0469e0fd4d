"""The network: the split form against the plain one, symmetries, the native message sum."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from benchmarks.peers.plain_network import PlainNetwork
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.graph import EDGE_KINDS, GraphSpec
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.native.messages import EdgeList, mean_messages, mean_messages_torch
from physworld.worldmodel.priors.modal import rigid_prior
from physworld.worldmodel.rollout import unroll

SAME_FUNCTION = 1e-5  # of outputs of order one, in single precision
SCALES = Normalisation(
    velocity=3e-3,
    change=1e-3,
    relative=(1e-3, 2e-3, 3e-3),
    strain=(4e-3, 5e-3, 6e-3),
    stretch=(2e-3, 3e-3, 4e-3),
    properties=(0.2, 0.1),
)


def _model(spec: GraphSpec, hidden: int = SMALL.hidden) -> WorldModel:
    """Random weights everywhere, the ones that start at zero too."""
    torch.manual_seed(0)
    model = WorldModel(dataclasses.replace(SMALL, hidden=hidden), spec, SCALES)
    with torch.no_grad():
        for parameter in (model.skip.weight, model.decoder.out.weight, model.decoder.out.bias):
            parameter.normal_(0.0, 0.2)
        model.prior.basis.normal_(0.0, 0.1)
        model.prior.weight.normal_(0.0, 0.1)
        model.prior.response.normal_(0.0, 0.1)
        model.prior.span.copy_(torch.tensor([-0.1, 0.1]))
    return model


def _state(spec: GraphSpec, batch: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A window, the next control positions, and properties."""
    generator = torch.Generator().manual_seed(1)
    n, slots = spec.object_count, spec.neighbours[spec.object_count :, 0]
    controls = spec.rest_vertices[slots] - spec.rest_relative[n:, 0]
    places = torch.as_tensor(np.concatenate([spec.rest_vertices, controls]), dtype=torch.float32)
    shape = (SMALL.history + 1, spec.vertex_count, batch, 3)
    window = places[None, :, None] + 3e-3 * torch.randn(shape, generator=generator)
    control_next = window[-1, n:] + 2e-3
    return window, control_next, 0.2 * torch.randn((n, batch, 2), generator=generator)


@pytest.mark.parametrize("ground", [None, -0.01])
def test_the_split_form_is_the_same_function_as_the_plain_one(ground: float | None) -> None:
    spec = graph(ground_height_m=ground)
    model = _model(spec)
    window, control_next, phi = _state(spec)
    ahead = torch.cat([model.prior(window, control_next, phi), control_next])
    plain = PlainNetwork(model)(window, ahead, phi)
    assert torch.allclose(
        model(window, ahead, phi), plain, atol=SAME_FUNCTION * float(plain.detach().abs().max())
    )


def test_both_forms_have_the_same_gradients() -> None:
    spec = graph()
    model = _model(spec)
    window, control_next, phi = _state(spec)
    ahead = torch.cat([model.prior(window, control_next, phi), control_next])
    weights = list(model.parameters())
    split = torch.autograd.grad(model(window, ahead, phi).square().sum(), weights)
    plain = torch.autograd.grad(PlainNetwork(model)(window, ahead, phi).square().sum(), weights)
    for a, b in zip(split, plain, strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))


def test_a_step_is_equivariant_to_translations() -> None:
    spec = graph()
    model = _model(spec)
    window, control_next, phi = _state(spec)
    shift = torch.tensor([0.4, -0.3, 0.5])
    with torch.inference_mode():
        here = model.step(window, control_next, phi)
        there = model.step(window + shift, control_next + shift, phi)
    assert torch.allclose(there - shift, here, atol=1e-6)
    assert not torch.allclose(here[: spec.object_count], window[-1, : spec.object_count], atol=1e-4)


def test_with_a_ground_only_horizontal_translations_are_free() -> None:
    spec = graph(ground_height_m=0.0)
    model = _model(spec)
    window, control_next, phi = _state(spec)
    window, control_next = (
        window + torch.tensor([0.0, 0.0, 0.02]),
        control_next + torch.tensor([0.0, 0.0, 0.02]),
    )
    with torch.inference_mode():
        here = model.step(window, control_next, phi)
        for shift, same in ((torch.tensor([0.4, 0.1, 0.0]), True), (torch.tensor([0.0, 0.0, 0.03]), False)):
            there = model.step(window + shift, control_next + shift, phi)
            assert torch.allclose(there - shift, here, atol=1e-6) == same


def test_control_vertices_go_where_they_are_sent_and_nobody_else_sees_the_batch() -> None:
    spec = graph()
    model = _model(spec)
    window, control_next, phi = _state(spec)
    with torch.inference_mode():
        together = model.step(window, control_next, phi)
        alone = model.step(window[:, :, 1:2], control_next[:, 1:2], phi[:, 1:2])
    assert torch.equal(together[spec.object_count :], control_next)
    assert torch.allclose(together[:, 1:2], alone, atol=1e-6)


def test_an_untrained_network_leaves_the_prior_as_it_is() -> None:
    spec = graph()
    model = WorldModel(SMALL, spec, SCALES)
    window, control_next, phi = _state(spec)
    with torch.inference_mode():
        moved = model.step(window, control_next, phi)
        assert torch.equal(moved[: spec.object_count], model.prior(window, control_next, phi))


def test_the_rigid_prior_follows_the_grip() -> None:
    spec = graph()
    prior = rigid_prior(spec.rest_vertices, spec.rest_vertices[: spec.control_count], SMALL.history)
    model = WorldModel(SMALL, spec, SCALES, prior)
    window, control_next, phi = _state(spec)
    with torch.inference_mode():
        moved = model.prior(window, control_next, phi)
    gap = moved - control_next.mean(dim=0)
    rest = spec.rest_vertices - spec.rest_vertices[: spec.control_count].mean(axis=0)
    assert gap[:, 0].numpy() == pytest.approx(rest, abs=1e-6)


@pytest.mark.parametrize("ground", [None, -0.01])
@pytest.mark.parametrize("hidden", [16, 24])
def test_the_native_rollout_is_that_of_torch(hidden: int, ground: float | None) -> None:
    spec = graph(ground_height_m=ground)
    model = _model(spec, hidden)
    window, control_next, phi = _state(spec, batch=1)
    drift = torch.linspace(0.0, 0.05, 20)[:, None, None, None]
    driven = torch.cat([window[:, spec.object_count :], control_next + drift])
    expected = unroll(model, window[:, : spec.object_count], driven, phi)[:, :, 0].numpy()
    native = RolloutEngine(model).run(
        window[:, : spec.object_count, 0].numpy(), driven[:, :, 0].numpy(), phi[:, 0].numpy()
    )
    assert np.abs(expected[-1] - expected[SMALL.history]).max() > 1e-2
    assert native == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("hidden", [16, 40, 7, 64, 90])
def test_native_mean_messages_are_those_of_torch(hidden: int) -> None:
    generator = torch.Generator().manual_seed(2)
    spec = graph()
    edges = EdgeList.from_neighbours(spec.neighbours, spec.edge_kind, EDGE_KINDS)
    count, batch = len(edges.senders), 3

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator).requires_grad_()

    inputs = (
        normal(EDGE_KINDS, spec.vertex_count, batch, hidden),
        normal(EDGE_KINDS, spec.vertex_count, batch, hidden),
        normal(count, hidden),
        normal(count, batch),
        normal(EDGE_KINDS, hidden),
    )
    slope = torch.randn(inputs[0].shape, generator=generator)
    native, plain = mean_messages(edges, *inputs), mean_messages_torch(edges, *inputs)
    assert torch.allclose(native, plain, atol=1e-5)
    for a, b in zip(
        torch.autograd.grad(native, inputs, slope), torch.autograd.grad(plain, inputs, slope), strict=True
    ):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-4)


def test_a_vertex_that_nobody_speaks_to_hears_nothing() -> None:
    neighbours = np.array([[2, 2], [0, 2]])
    edges = EdgeList.from_neighbours(neighbours, np.zeros_like(neighbours), 1)
    one = torch.ones((1, 2, 1, 16))
    heard = mean_messages(edges, one, one, torch.zeros(1, 16), torch.zeros(1, 1), torch.zeros(1, 16))
    assert heard[0, 0].abs().max() == 0.0
    assert torch.equal(heard[0, 1], 2.0 * one[0, 1])
