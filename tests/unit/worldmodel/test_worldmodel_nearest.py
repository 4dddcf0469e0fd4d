"""NEAR edges of the current shape: the search, the network that hears along them, the engine, a published version."""

from __future__ import annotations

import dataclasses

import numpy as np
import onnxruntime
import pytest
import torch
from held_bar import SMALL, graph
from scipy.spatial import cKDTree

from benchmarks.peers.plain_network import PlainNetwork
from physworld.worldmodel.dataset import Track, measure_scales, read_track
from physworld.worldmodel.export import INPUTS, StepProgram, edge_list, onnx_program
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.graph import NEAR, GraphSpec
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.nearest import find_nearest
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.rollout import unroll
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

CURRENT = dataclasses.replace(SMALL, near_edges="current")
SCALES = Normalisation(
    velocity=3e-3,
    change=1e-3,
    relative=(1e-3, 2e-3, 3e-3),
    strain=(4e-3, 5e-3, 6e-3),
    stretch=(2e-3, 3e-3, 4e-3),
    properties=(0.2, 0.1),
)
SAME_FUNCTION = 1e-5  # of outputs of order one, in single precision


def spec_of(config: WorldModelConfig = CURRENT, radius_m: float | None = None) -> GraphSpec:
    """The bar's graph, with a smaller radius where some vertices are to hear fewer than they may."""
    spec = graph(config)
    return spec if radius_m is None else dataclasses.replace(spec, edge_radius_m=radius_m)


def model_of(spec: GraphSpec, config: WorldModelConfig = CURRENT) -> WorldModel:
    torch.manual_seed(0)
    model = WorldModel(config, spec, SCALES)
    with torch.no_grad():
        for parameter in (model.skip.weight, model.decoder.out.weight, model.decoder.out.bias):
            parameter.normal_(0.0, 0.2)
    return model


def folded(spec: GraphSpec, batch: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A window of bars that are bent back on themselves, so that far parts are near; next controls; properties."""
    generator = torch.Generator().manual_seed(1)
    n, slots = spec.object_count, spec.neighbours[spec.object_count :, 0]
    places = np.concatenate([spec.rest_vertices, spec.rest_vertices[slots]])
    far = places[:, 0] > 0.08
    places[far, 0] = 0.16 - places[far, 0]
    places[far, 2] += 0.02
    shape = (SMALL.history + 1, spec.vertex_count, batch, 3)
    window = torch.as_tensor(places, dtype=torch.float32)[None, :, None]
    window = window + 3e-3 * torch.randn(shape, generator=generator)
    return window, window[-1, n:] + 2e-3, 0.2 * torch.randn((n, batch, 2), generator=generator)


@pytest.mark.parametrize(("n", "most", "radius"), [(146, 7, 0.3), (90, 10, 0.11), (5, 4, 0.4), (200, 3, 2.0)])
def test_the_search_finds_what_a_tree_finds(n: int, most: int, radius: float) -> None:
    places = np.random.default_rng(n).uniform(0.0, 1.0, (4, n, 3)).astype(np.float32)
    senders, counts = find_nearest(places, most, radius)
    assert len(np.unique(counts)) > 1 or counts[0, 0] == most
    for cloud, rows, kept in zip(places, senders, counts, strict=True):
        distance, index = cKDTree(cloud.astype(float)).query(cloud, most + 1, distance_upper_bound=radius)
        for i in range(n):
            wanted = sorted(int(j) for j in index[i][np.isfinite(distance[i])] if j != i)
            assert rows[i, : kept[i]].tolist() == wanted
            assert (rows[i, kept[i] :] == -1).all()


def test_of_equal_distances_the_lower_index_goes_first() -> None:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]], dtype=np.float32)
    senders, counts = find_nearest(corners, 3, 1.2)
    assert senders[0, 0].tolist() == [1, 2, 3]
    assert counts[0].tolist() == [3, 1, 1, 1, 1]


def test_the_split_form_is_the_same_function_as_the_plain_one() -> None:
    spec = spec_of(radius_m=0.026)
    model = model_of(spec)
    window, control_next, phi = folded(spec)
    ahead = torch.cat([model.prior(window, control_next, phi), control_next])
    plain = PlainNetwork(model)(window, ahead, phi)
    found = edge_list(spec, window[-1, :, 0].numpy())
    near = found["kinds"] == NEAR
    assert np.linalg.norm(found["rest_relative"][near], axis=1).max() > 2.0 * spec.edge_radius_m  # what meets
    assert 0 < near.sum() < spec.object_count * spec.current_neighbours  # and not everybody hears as many
    assert torch.allclose(
        model(window, ahead, phi), plain, atol=SAME_FUNCTION * float(plain.detach().abs().max())
    )
    weights = list(model.parameters())
    split = torch.autograd.grad(model(window, ahead, phi).square().sum(), weights)
    other = torch.autograd.grad(PlainNetwork(model)(window, ahead, phi).square().sum(), weights)
    for a, b in zip(split, other, strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))


def test_the_gradient_by_places_is_that_of_finite_differences() -> None:
    spec = spec_of(radius_m=0.026)
    model = model_of(spec).double()
    window, control_next, phi = (values.double() for values in folded(spec, batch=2))
    ahead = torch.cat([model.prior(window, control_next, phi), control_next])
    window.requires_grad_()
    slope = torch.randn(window.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    (gradient,) = torch.autograd.grad(model(window, ahead, phi).square().sum(), window)
    with torch.no_grad():
        sides = [float(model(window + h * slope, ahead, phi).square().sum()) for h in (1e-7, -1e-7)]
    assert float((gradient * slope).sum()) == pytest.approx((sides[0] - sides[1]) / 2e-7, rel=1e-4)


@pytest.mark.parametrize(("hidden", "radius"), [(16, 0.026), (24, 0.026), (16, 0.3)])
def test_the_native_rollout_is_that_of_torch(hidden: int, radius: float) -> None:
    """At the larger radius every vertex has all its neighbours, and those of a step bound the next search."""
    config = dataclasses.replace(CURRENT, hidden=hidden)
    spec = spec_of(config, radius_m=radius)
    model = model_of(spec, config)
    window, control_next, phi = folded(spec)
    n = spec.object_count
    drift = torch.linspace(0.0, 0.05, 12)[:, None, None, None]
    driven = torch.cat([window[:, n:], control_next + drift])
    expected = unroll(model, window[:, :n], driven, phi).permute(2, 0, 1, 3).numpy()
    native = RolloutEngine(model).run_batch(
        window[:, :n].permute(2, 0, 1, 3).numpy(),
        driven.permute(2, 0, 1, 3).numpy(),
        phi.permute(1, 0, 2).numpy(),
        threads=2,
    )
    assert np.abs(expected[:, -1] - expected[:, SMALL.history]).max() > 1e-2
    assert native == pytest.approx(expected, abs=1e-5)


def test_the_order_of_vertices_and_of_the_batch_does_not_matter() -> None:
    spec = spec_of(radius_m=0.026)
    model = model_of(spec)
    window, control_next, phi = folded(spec)
    n = spec.object_count
    order = np.random.default_rng(0).permutation(n)
    place = np.argsort(order)
    whole = np.concatenate([order, np.arange(n, spec.vertex_count)])
    to_new = np.concatenate([place, np.arange(n, spec.vertex_count + 1)])
    other_spec = dataclasses.replace(
        spec,
        rest_vertices=spec.rest_vertices[order],
        particle_index=spec.particle_index[order],
        neighbours=to_new[spec.neighbours[whole]],
        edge_kind=spec.edge_kind[whole],
        rest_relative=spec.rest_relative[whole],
    )
    other = WorldModel(CURRENT, other_spec, SCALES)
    weights = {name: value for name, value in model.state_dict().items() if not name.startswith("prior.")}
    other.load_state_dict(weights, strict=False)
    ahead = torch.cat([window[-1, :n], control_next])
    with torch.inference_mode():
        here = model(window, ahead, phi)
        there = other(window[:, whole], ahead[whole], phi[order])
        turned = model(window.flip(2), ahead.flip(1), phi.flip(1)).flip(1)
    assert torch.allclose(there, here[order], atol=1e-5)
    assert torch.allclose(turned, here, atol=1e-6)


def test_what_passes_by_is_heard_only_with_current_edges() -> None:
    """The bar's free end comes near its middle: with material edges its middle hears it through the bar alone."""
    answers = {}
    for config in (SMALL, CURRENT):
        config = dataclasses.replace(config, message_passing_steps=1, coarse_links=0, coarse_vertices=0)
        spec = spec_of(config, radius_m=0.026)
        model = model_of(spec, config)
        window, control_next, phi = folded(spec, batch=1)
        ahead = torch.cat([window[-1, : spec.object_count], control_next])
        free = np.argmax(spec.rest_vertices[:, 0])
        moved = window.clone()
        moved[:, free] += 0.004
        with torch.inference_mode():
            change = (model(moved, ahead, phi) - model(window, ahead, phi))[:, 0].abs().amax(dim=1).numpy()
        far = spec.rest_vertices[free, 0] - spec.rest_vertices[:, 0] > 0.09
        answers[config.near_edges] = float(change[far & (np.arange(len(far)) != free)].max())
    assert answers["material"] == 0.0
    assert answers["current"] > 1e-4


def test_a_step_program_is_given_the_edges_of_the_moment() -> None:
    spec = spec_of(radius_m=0.026)
    model = model_of(spec)
    window, control_next, phi = folded(spec, batch=1)
    edges = edge_list(spec, window[-1, :, 0].numpy())
    inputs = {"window": window[:, :, 0], "control_next": control_next[:, 0], "phi": phi[:, 0]}
    inputs |= {name: torch.as_tensor(values) for name, values in edges.items()}
    with torch.inference_mode():
        moved = StepProgram(model)(*(inputs[name] for name in INPUTS))
        expected = model.step(window, control_next, phi)[:, 0]
    assert torch.allclose(moved, expected, atol=1e-5)
    session = onnxruntime.InferenceSession(onnx_program(model), providers=["CPUExecutionProvider"])
    (following,) = session.run(None, {name: values.numpy() for name, values in inputs.items()})
    assert following == pytest.approx(expected.numpy(), abs=1e-5)


def test_scales_are_those_of_the_edges_that_there_are(tracks: list[Track]) -> None:
    """Of a track that hardly deforms they are those of the nearest material neighbours."""
    spec = spec_of()
    still = Track(tracks[0].positions[:1].repeat(5, 1, 1), tracks[0].phi)
    scales = measure_scales([still], spec, lambda track: track.positions[1:, :1])
    assert scales.strain[NEAR] < 1e-6 and scales.relative[NEAR] < 1e-6
    bar = still.positions[0, : spec.object_count].numpy()
    moved = still.positions.clone()
    moved[:, : spec.object_count] = torch.as_tensor(1.1 * bar)
    stretched = measure_scales([Track(moved, still.phi)], spec, lambda track: track.positions[1:, :1])
    senders, _ = find_nearest(1.1 * bar[None], spec.current_neighbours, spec.edge_radius_m)
    lengths = np.linalg.norm(bar[senders[0]] - bar[:, None], axis=2)[senders[0] >= 0]
    assert stretched.stretch[NEAR] == pytest.approx(0.1 * np.sqrt((lengths**2).mean()), rel=1e-3)


def test_training_learns_and_resumes(episodes: list[dict[str, np.ndarray]]) -> None:
    spec = spec_of()
    tracks = [read_track(spec, arrays, SMALL.history) for arrays in episodes]
    settings = TrainingConfig(
        steps=12, look_ahead=4, validation_every=6, checkpoint_every=6, learning_rate=3e-3
    )
    kept: list[bytes] = []
    whole = train(tracks, spec, CURRENT, settings, save_checkpoint=kept.append)
    again = train(tracks, spec, CURRENT, settings, checkpoint=kept[0])
    assert whole.losses[-1][1] < 1.0  # of what the prior leaves
    for a, b in zip(whole.model.parameters(), again.model.parameters(), strict=True):
        assert torch.equal(a, b)


def test_another_kind_of_edges_is_refused() -> None:
    with pytest.raises(ValueError, match="near_edges 'spatial'"):
        WorldModelConfig(near_edges="spatial")
