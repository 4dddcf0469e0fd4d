"""The NumPy world model of the client against the trained network, on the same files."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from physworld_client.errors import DigestMismatch, ModelUnreadable
from physworld_client.known_keys import KnownKeys
from physworld_client.world_model import WorldModel
from safetensors.numpy import load_file, save_file

from physworld.worldmodel import PublishedModel, WorldModelConfig, affine_skin, build_graph
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.model.model import WorldModel as Network
from physworld.worldmodel.model.skinning import Beside
from physworld.worldmodel.priors.modal import ModalPrior, regressor_count, rigid_prior
from physworld_storage import signing

FRAMES = 60
SIGNER = signing.signer_of(base64.b64encode(bytes(range(32))).decode(), "the test")
AGREEMENT = 5e-5  # of the largest coordinate: single precision over 60 steps of an untrained, growing motion


@pytest.fixture(autouse=True)
def known(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """This machine has met the service that signs here."""
    monkeypatch.setenv("PHYSWORLD_KNOWN_KEYS", str(tmp_path_factory.mktemp("keys") / "known.json"))
    KnownKeys().trust("the test", SIGNER.public_key)


def published(
    ground_height_m: float | None = None, near_edges: str = "material", *, alone: bool = False
) -> PublishedModel:
    """An untrained network on a bar that two grips of three controllers hold, with weights that move it; ``alone``:
    without a prior.
    """
    rng = np.random.default_rng(7)
    particles = rng.uniform(0.0, 1.0, (400, 3)) * [0.3, 0.04, 0.04]
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, 0.0, 0.04]])
    controllers = np.concatenate([ends, ends + np.array([0.3, 0.0, 0.0])])
    config = WorldModelConfig(
        hidden=24, message_passing_steps=3, history=3, vertices=40, neighbours=6, near_edges=near_edges
    )
    spec = build_graph(
        particles,
        particles,
        controllers,
        dt_s=1.0 / 30.0,
        config=config,
        control_groups=(np.arange(3), np.arange(3, 6)),
        ground_height_m=ground_height_m,
    )
    scales = {"velocity": 5e-3, "change": 1e-3}
    names = {field.name for field in dataclasses.fields(Normalisation)} - {*scales, "properties"}
    torch.manual_seed(3)
    prior = InertialPrior(spec.object_count) if alone else some_prior(spec, config.history, rng)
    model = Network(config, spec, Normalisation(**scales, properties=(0.2, 0.1)), prior)
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.02)
        for name in names:
            buffer = getattr(model.norm, name)
            buffer.copy_(torch.linspace(0.01, 0.02, buffer.numel()))
    history = np.repeat(spec.rest_vertices[None], config.history + 1, axis=0)
    history += np.linspace(0.0, 1e-3, config.history + 1)[:, None, None]
    return PublishedModel(
        model=model,
        phi=rng.normal(0.0, 0.1, (spec.object_count, 2)),
        phi_calibrated=np.zeros((spec.object_count, 2)),
        start_history=history,
        start_controllers=np.repeat(controllers[None], config.history + 1, axis=0),
        start_time_s=0.5,
        skin=affine_skin(particles[:13], spec.rest_vertices),
    )


def some_prior(spec: GraphSpec, history: int, rng: np.random.Generator) -> ModalPrior:
    """Five modes that swing, and answer the grips a little: none of its terms is zero."""
    n, modes = spec.object_count, 5
    control_places = spec.rest_vertices[spec.neighbours[n:, 0]]
    prior = rigid_prior(spec.rest_vertices, control_places, history)
    basis = np.linalg.qr(rng.normal(size=(3 * n, modes)))[0].T.reshape(modes, n, 3)
    weight = rng.normal(0.0, 0.02, (modes, regressor_count(modes, spec.control_count, history)))
    weight[:, :modes] += 1.8 * np.eye(modes)
    weight[:, modes : 2 * modes] -= 0.85 * np.eye(modes)
    response = rng.normal(0.0, 0.005, (2, modes, (history + 1) * modes + 1))
    placing = prior.placing + rng.normal(0.0, 0.5 / n, (n, 2))
    return dataclasses.replace(
        prior, basis=basis, weight=weight, response=response, placing=placing, span=np.array([-0.4, 0.3])
    )


def write(folder: Path, model: PublishedModel) -> str:
    """The files of a version; the digest of its manifest."""
    save_file(model.to_tensors(), folder / "model.safetensors")
    (folder / "card.json").write_text(json.dumps({"schema_version": 1, "architecture": model.facts()}))
    return seal(folder)


def seal(folder: Path) -> str:
    """Writes the manifest of the files as they are."""
    files = {}
    for name in ("model.safetensors", "card.json"):
        data = (folder / name).read_bytes()
        files[name] = {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)}
    text = json.dumps({"name": "bar", "version": 4, "files": files})
    (folder / "manifest.json").write_text(text)
    (folder / "manifest.sig.json").write_bytes(SIGNER.sign(text.encode()))
    return hashlib.sha256(text.encode()).hexdigest()


def driven(model: PublishedModel) -> np.ndarray:
    """Controllers (T, K, 3): the left grip swings, the right one stands."""
    controllers = np.repeat(model.start_controllers[:1], FRAMES, axis=0)
    swing = 0.05 * np.sin(np.arange(FRAMES) / 8.0) * (np.arange(FRAMES) > 3)
    controllers[:, :3, 2] += swing[:, None]
    return controllers


@pytest.mark.parametrize(
    ("ground", "near_edges", "alone"),
    [
        (None, "material", False),
        (-0.02, "material", False),
        (None, "current", False),
        (None, "material", True),
    ],
    ids=["free", "ground", "current edges", "no prior"],
)
def test_both_networks_move_the_same_way(
    tmp_path: Path, ground: float | None, near_edges: str, alone: bool
) -> None:
    original = published(ground, near_edges, alone=alone)
    write(tmp_path, original)
    reference = PublishedModel.from_tensors(load_file(tmp_path / "model.safetensors"), original.facts())
    loaded = WorldModel.load(tmp_path)
    controllers = driven(original)

    expected = reference.rollout(controllers)
    found = loaded.rollout(controllers)
    assert np.abs(expected - expected[:1]).max() > 0.02, "a model that stands still proves nothing"
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < AGREEMENT * np.abs(expected).max()

    stiffer = original.phi + np.array([np.log(2.0), 0.0])
    rest = np.repeat(loaded.rest_vertices[None], loaded.history + 1, axis=0)
    expected = reference.rollout(controllers, history=rest, phi=stiffer)
    found = loaded.rollout(controllers, stiffer, history=rest)
    assert np.abs(found - expected).max() < AGREEMENT * np.abs(expected).max()

    by_name = loaded.rollout(controllers, {"stiffness": stiffer[:, 0]}, history=rest)
    assert np.array_equal(
        by_name,
        loaded.rollout(controllers, np.stack([stiffer[:, 0], loaded.phi[:, 1]], axis=1), history=rest),
    )

    points = loaded.track(expected)
    assert points.shape == (FRAMES, 13, 3)
    assert np.abs(points - reference.skin.apply(expected)).max() < 1e-9


@pytest.mark.parametrize("rope", [False, True], ids=["sheet", "rope"])
def test_points_beside_the_vertices_are_where_the_service_has_them(tmp_path: Path, rope: bool) -> None:
    original = published()
    rng, shape = np.random.default_rng(3), original.skin.weight.shape
    slope = rng.normal(size=(2, *shape))
    slope -= slope.mean(axis=2, keepdims=True)
    line = rng.normal(size=(shape[0], 3))
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    offset = rng.uniform(0.01, 0.02, (shape[0], 3))
    if rope:
        slope[1] = 0.0
    else:
        line[:], offset[:, :2] = 0.0, 0.0
    moved = dataclasses.replace(original.skin, beside=Beside(slope, offset, line))
    write(tmp_path, dataclasses.replace(original, skin=moved))
    tensors = load_file(tmp_path / "model.safetensors")
    assert "skin.index" not in tensors, "a reader that does not know of offsets finds no points"
    reference = PublishedModel.from_tensors(tensors, original.facts())
    vertices = original.start_history + rng.normal(0.0, 0.01, original.start_history.shape)
    found = WorldModel.load(tmp_path).track(vertices)
    assert found == pytest.approx(reference.skin.apply(vertices), abs=1e-12)
    assert found == pytest.approx(moved.apply(vertices), abs=1e-6)
    assert np.linalg.norm(found - original.skin.apply(vertices), axis=2).min() > 0.009
    short = tensors | {"skin.offset": tensors["skin.offset"][:-1]}
    with pytest.raises(VersionUnreadable, match=r"skin\.offset"):
        PublishedModel.from_tensors(short, original.facts())


def test_the_facts_are_those_of_the_recording(tmp_path: Path) -> None:
    original = published()
    digest = write(tmp_path, original)
    loaded = WorldModel.load(tmp_path, sha256=digest)
    assert (loaded.name, loaded.version, loaded.history, loaded.controller_count) == ("bar", 4, 3, 6)
    assert (loaded.dt_s, loaded.start_time_s, loaded.ground_height_m) == (1.0 / 30.0, 0.5, None)
    assert np.array_equal(loaded.control_index, original.spec.control_index)
    assert np.allclose(loaded.phi, original.phi, atol=1e-7)
    assert not loaded.phi_calibrated.any()


def test_wrong_shapes_are_named(tmp_path: Path) -> None:
    model = published()
    write(tmp_path, model)
    loaded = WorldModel.load(tmp_path)
    with pytest.raises(ValueError, match=r"controllers \(60, 5, 3\), not \(T >= 4, 6, 3\)"):
        loaded.rollout(driven(model)[:, :5])
    with pytest.raises(ValueError, match="controllers"):
        loaded.rollout(driven(model)[:3])
    with pytest.raises(ValueError, match=r"phi \(2,\)"):
        loaded.rollout(driven(model), np.zeros(2))
    with pytest.raises(ValueError, match="no column 'mass'; it has stiffness, density"):
        loaded.rollout(driven(model), {"mass": 0.1})
    with pytest.raises(ValueError, match=r"a place 1e\+300 m from the origin.*; 1000 m is the farthest"):
        loaded.rollout(np.where(np.arange(FRAMES)[:, None, None] == 9, 1e300, driven(model)))
    with pytest.raises(ValueError, match="18 values of controllers, history and phi are no finite numbers"):
        loaded.rollout(np.where(np.arange(FRAMES)[:, None, None] == 9, np.nan, driven(model)))


def test_changed_weights_are_not_loaded(tmp_path: Path) -> None:
    write(tmp_path, published())
    weights = tmp_path / "model.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    with pytest.raises(DigestMismatch, match=r"model\.safetensors"):
        WorldModel.load(tmp_path)


def test_another_version_than_the_one_asked_for_is_refused(tmp_path: Path) -> None:
    write(tmp_path, published())
    with pytest.raises(DigestMismatch, match=r"manifest\.json"):
        WorldModel.load(tmp_path, sha256="0" * 64)


@pytest.mark.parametrize("tensor", ["skip.weight", "phi", "graph.edge_kind", "encoder.in.weight"])
def test_a_missing_tensor_is_named(tmp_path: Path, tensor: str) -> None:
    model = published()
    tensors = model.to_tensors()
    del tensors[tensor]
    save_file(tensors, tmp_path / "model.safetensors")
    (tmp_path / "card.json").write_text(json.dumps({"schema_version": 1, "architecture": model.facts()}))
    seal(tmp_path)
    with pytest.raises(ModelUnreadable, match=tensor):
        WorldModel.load(tmp_path).rollout(driven(model))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("card.json", b"{}"),
        ("card.json", b'{"schema_version": 2, "architecture": {"dt_s": 1, "ground_height_m": null}}'),
        ("model.safetensors", b"not tensors"),
    ],
)
def test_an_unknown_layout_is_refused(tmp_path: Path, name: str, data: bytes) -> None:
    write(tmp_path, published())
    (tmp_path / name).write_bytes(data)
    seal(tmp_path)
    with pytest.raises(ModelUnreadable, match="not a world model of a known layout"):
        WorldModel.load(tmp_path)


def test_the_client_runs_without_torch_and_warp(tmp_path: Path) -> None:
    write(tmp_path, published())
    program = (
        "import sys\n"
        "import physworld_client.cli\n"
        "from physworld_client.world_model import WorldModel\n"
        "model = WorldModel.load(sys.argv[1])\n"
        "model.rollout(model.start_controllers.repeat(2, axis=0))\n"
        "ours = ('torch', 'warp', 'physworld', 'storage', 'services', 'workers', 'celery', 'sqlalchemy')\n"
        "print([name for name in ours if name in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_the_python_of_the_tutorial_runs_as_it_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "tutorial.md").read_text()
    code = page.partition("```python\n")[2].partition("```")[0]
    folder = tmp_path / "path" / "that" / "was" / "printed"
    folder.mkdir(parents=True)
    original = published()
    write(folder, original)
    monkeypatch.chdir(tmp_path)
    found: dict[str, np.ndarray] = {}
    exec(code, found)
    driven_at_last = found["controllers"][-1] - original.start_controllers[-1]
    assert driven_at_last[:, 2] == pytest.approx(0.05) and np.isfinite(found["vertices"]).all()
    assert found["points"].shape == (40, 13, 3)
