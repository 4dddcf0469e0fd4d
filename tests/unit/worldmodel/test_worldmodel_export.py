"""One step as a ``torch.export`` program and as ONNX, against our engine."""

from __future__ import annotations

import io
import json
import re
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from held_bar import SMALL, graph
from safetensors.numpy import save_file

from physworld.worldmodel import PublishedModel, affine_skin
from physworld.worldmodel.dataset import Track
from physworld.worldmodel.export import INPUTS, edge_list, onnx_program, torch_program
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.priors.modal import fit_prior

pytestmark = pytest.mark.slow

AGREEMENT_M = 1e-5
DOCS = Path(__file__).resolve().parents[3] / "docs" / "models.md"


@pytest.fixture(scope="module")
def model(tracks: list[Track]) -> WorldModel:
    """An untrained network whose every term moves the bar, on a prior fitted to it."""
    spec = graph(ground_height_m=-0.1)
    prior = fit_prior(
        [t.positions.numpy() for t in tracks],
        [t.phi.numpy() for t in tracks],
        spec.object_count,
        SMALL.history,
        SMALL.modes,
    )
    torch.manual_seed(1)
    scales = dict.fromkeys(("relative", "strain", "stretch"), (0.01, 0.02, 0.03))
    model = WorldModel(
        SMALL, spec, Normalisation(velocity=5e-3, change=2e-3, properties=(0.5, 0.3), **scales), prior
    )
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.05)
        model.decoder.out.weight.normal_(0.0, 0.3)
    return model


@pytest.fixture(scope="module")
def onnx_file(model: WorldModel) -> bytes:
    return onnx_program(model)


@pytest.fixture(scope="module")
def programs(model: WorldModel, onnx_file: bytes) -> tuple[onnxruntime.InferenceSession, torch.nn.Module]:
    session = onnxruntime.InferenceSession(onnx_file, providers=["CPUExecutionProvider"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own container
        loaded = torch.export.load(io.BytesIO(torch_program(model)))
    return session, loaded.module()


def inputs_of(model: WorldModel, track: Track, tick: int, phi: np.ndarray) -> dict[str, np.ndarray]:
    frames, n = model.config.history + 1, model.spec.object_count
    x = track.positions.numpy()
    return {
        "window": x[tick : tick + frames],
        "control_next": x[tick + frames, n:],
        "phi": phi.astype(np.float32),
        **edge_list(model.spec),
    }


def through_both(
    programs: tuple[onnxruntime.InferenceSession, torch.nn.Module], inputs: dict[str, np.ndarray]
) -> list[np.ndarray]:
    session, program = programs
    with torch.inference_mode():
        second = program(*[torch.as_tensor(inputs[name]) for name in INPUTS]).numpy()
    return [session.run(None, inputs)[0], second]


def test_both_agree_with_the_engine(
    model: WorldModel, programs: tuple[onnxruntime.InferenceSession, torch.nn.Module], tracks: list[Track]
) -> None:
    n, frames = model.spec.object_count, model.config.history + 1
    phi = np.random.default_rng(3).normal(0.0, 0.4, (n, 2))
    engine = RolloutEngine(model)
    moved = 0.0
    for track, tick in zip(tracks[:4], (0, 7, 15, 30), strict=True):
        inputs = inputs_of(model, track, tick, phi)
        x = track.positions.numpy()[tick : tick + frames + 1]
        expected = engine.run(x[:frames, :n], x[:, n:], phi)[frames]
        for found in through_both(programs, inputs):
            assert found.shape == expected.shape
            assert np.abs(found - expected).max() < AGREEMENT_M
        moved = max(moved, float(np.abs(expected[:n] - x[frames - 1, :n]).max()))
    assert moved > 1e-3, "a step that moves nothing proves nothing"


def test_the_number_of_edges_is_free(
    model: WorldModel, programs: tuple[onnxruntime.InferenceSession, torch.nn.Module], tracks: list[Track]
) -> None:
    whole = inputs_of(model, tracks[0], 5, np.zeros((model.spec.object_count, 2)))
    for kept in (1, len(whole["senders"]) // 2):
        fewer = {name: value[:kept] if name in INPUTS[3:] else value for name, value in whole.items()}
        first, second = through_both(programs, fewer)
        assert np.abs(first - second).max() < AGREEMENT_M
        assert np.abs(first - through_both(programs, whole)[0]).max() > 1e-6
    shuffled = np.random.default_rng(0).permutation(len(whole["senders"]))
    other = {name: value[shuffled] if name in INPUTS[3:] else value for name, value in whole.items()}
    assert np.abs(through_both(programs, other)[0] - through_both(programs, whole)[0]).max() < AGREEMENT_M


def test_the_example_of_the_documentation_rolls_the_published_model_out(
    model: WorldModel, onnx_file: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, frames = model.spec, model.config.history + 1
    rest = spec.rest_vertices
    controllers = np.zeros((frames, int(spec.control_index.max()) + 1, 3))
    controllers[:, spec.control_index] = model._reference.numpy()[spec.object_count :] + rest.mean(axis=0)
    published = PublishedModel(
        model=model,
        phi=np.full((spec.object_count, 2), 0.1),
        phi_calibrated=np.zeros((spec.object_count, 2)),
        start_history=np.repeat(rest[None], frames, axis=0),
        start_controllers=controllers,
        start_time_s=0.0,
        skin=affine_skin(rest[:3], rest),
    )
    folder = tmp_path / "models" / "beam"
    folder.mkdir(parents=True)
    save_file(published.to_tensors(), folder / "model.safetensors")
    (folder / "card.json").write_text(json.dumps({"architecture": published.facts()}))
    (folder / "step.onnx").write_bytes(onnx_file)
    (example,) = re.findall(r"^```python\n(.*?)^```", DOCS.read_text(), re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, np.ndarray] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # the example leaves a file to the collector
        exec(compile(example, str(DOCS), "exec"), names)
    still = np.repeat(controllers[-1:], 30 + frames, axis=0)
    expected = published.rollout(still)[frames - 1 :]
    assert names["vertices"].shape == expected.shape == (31, spec.object_count, 3)
    assert np.abs(names["vertices"] - expected).max() < 30 * AGREEMENT_M
