"""The local stage of the service's fits: recorded, stored with the twin, used by its episodes, refused to a trace."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import box_body, made_scene
from pydantic import ValidationError
from test_tasks import _drain, _make_dataset
from tiny_scene import register

from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld_schemas.fit import Fit, FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_storage import resources
from physworld_storage.errors import Conflict
from physworld_storage.jobs import jobs
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import named, npz_arrays

pytestmark = pytest.mark.slow

SIZE = np.array([0.16, 0.02, 0.02])
CONFIG = FitConfig(
    particle_budget=60, max_simulations=40, damping="none", stages="global+local", numerics=False
)


def graded_bar(slope: float) -> Scene:
    """A bar that sags and swings from its clamp; its log stiffness falls by ``slope`` from the middle to the end."""
    plate = np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]])
    scene = made_scene(
        np.linspace([0.05, 0.01, 0.02], [0.16, 0.01, 0.02], 6), "beam", plate, 24,
        body=box_body([0, 0, 0], SIZE, density_kg_m3=1000.0), noise_sigma_m=2e-5,
        grips=(Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.02, 0.02])),), initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=4e5)
    properties = np.zeros((len(twin.particles_rest), 2))
    properties[:, 0] = slope * (2.0 * twin.particles_rest[:, 0] / SIZE[0] - 1.0)
    nodes = twin.simulate_nodes(*scene.control_track(), scene.times, properties=properties)
    noise = np.random.default_rng(0).normal(scale=2e-5, size=scene.points.shape)
    return Scene(**{**vars(scene), "points": twin.track_nodes(nodes) + noise})


def fitted(runtime, stores: Stores, scene: Scene) -> Fit:
    scene_id = register(scene, stores.database, stores.artifacts)
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, CONFIG)
    assert _drain(runtime) == ["done"]
    with stores.database.reading() as session:
        return resources.get_fit(session, job.outputs[0].id)


def test_a_field_is_kept_stored_and_demonstrated_with(runtime_with, stores: Stores) -> None:
    fit = fitted(runtime_with(), stores, graded_bar(-0.8))
    assert fit.local is not None and fit.local.kept and "kept" in fit.local.reason
    stiffness = fit.local.log_factors["stiffness"]
    assert stiffness["low"] < stiffness["mean"] < stiffness["high"]
    errors = fit.metrics["held_out"]["track_m"]
    assert errors["twin"] < 0.7 * errors["twin_homogeneous"]
    stored = stores.artifacts.read_bytes(named(fit.artifacts, "twin.npz", fit.id).sha256)
    twin = Twin.from_arrays(npz_arrays(stored))
    assert twin.properties is not None and np.ptp(twin.properties[:, 0]) > 0.2
    job, dataset = _make_dataset(runtime_with(), fit, episodes=1, frames=6)
    assert (job.state, dataset.state) == ("succeeded", "sealed")
    with stores.database.session() as session, pytest.raises(Conflict, match="carries a field"):
        jobs.create_trace(session, TraceCreate(scene_id=fit.scene_id, fit_id=fit.id))


def test_a_field_that_does_not_hold_leaves_the_global_fit(runtime_with, stores: Stores) -> None:
    fit = fitted(runtime_with(), stores, graded_bar(0.0))
    assert fit.local is not None and not fit.local.kept and "thrown away" in fit.local.reason
    assert "twin_homogeneous" not in fit.metrics["held_out"]["track_m"]
    with stores.database.session() as session:
        jobs.create_trace(session, TraceCreate(scene_id=fit.scene_id, fit_id=fit.id))


@pytest.mark.parametrize("other", [{"plasticity": "von_mises"}, {"formulation": "updated_lagrangian"}])
def test_a_field_over_a_body_without_a_gradient_is_refused(other: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match="total Lagrangian"):
        FitConfig.model_validate({"stages": "global+local", **other})


def test_a_loop_and_a_field_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match=r"fit\.stages"):
        PipelineCreate.model_validate(
            {"scene_id": "scn_x", "close_the_loop": True, "fit": {"stages": "global+local"}}
        )
