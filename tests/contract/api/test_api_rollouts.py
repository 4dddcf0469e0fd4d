"""Rollouts over the API with a real model behind it: small ones at once, large ones as jobs, and what is refused."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from inference_serving import Served, serve_inference
from published_tiny import publish_tiny, tiny_model

from physworld.worldmodel.errors import ControlsInvalid
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.rollout import SYNC_STEPS, RolloutCreate
from physworld_services.inference import rollouts
from physworld_services.inference.models import Models
from physworld_storage.jobs import leases
from physworld_workers.execute import Runtime, run_shard

SINGLE_PRECISION_M = 2e-6


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        yield served


def paths(candidates: int = 3, ticks: int = 16) -> np.ndarray:
    """Control paths (B, T, 4, 3) that begin as the recording does and then drift apart."""
    model = tiny_model()[2]
    past = model.start_controllers
    path = np.repeat(past[-1:], ticks, axis=0)
    path[: len(past)] = past
    drift = np.linspace(0.0, 0.02, ticks - len(past))[:, None, None] * np.array([0.0, 1.0, 1.0])
    batch = np.repeat(path[None], candidates, axis=0)
    batch[:, len(past) :] += np.linspace(-1.0, 1.0, candidates)[:, None, None, None] * drift
    return batch


def body(served: Served, controllers: np.ndarray, **more: object) -> dict[str, object]:
    encoded = EncodedArray.of(controllers).model_dump()
    return {"model": served.model, "controllers": encoded, **more}


def absurd(controllers: np.ndarray) -> np.ndarray:
    """The paths with one place that is finite, and beyond single precision."""
    changed = controllers.copy()
    changed[2, 5, 0, 1] = 1e300
    return changed


def arrays_of(client: httpx.Client, rollout: dict[str, Any]) -> dict[str, np.ndarray]:
    """The arrays of a rollout that was a job."""
    file = next(item for item in rollout["artifacts"] if item["name"] == "rollout.npz")
    with np.load(io.BytesIO(client.get(f"/v1/artifacts/{file['sha256']}").content)) as npz:
        return {name: npz[name] for name in npz.files}


def _work(served: Served, ends: str = "done") -> None:
    runtime = Runtime(served.settings, served.database, served.stores, "test")
    while True:
        with served.database.session() as session:
            waiting = leases.publishable(session)
            leases.mark_published(session, waiting)
        if not waiting:
            return
        for publication in waiting:
            assert run_shard(runtime, publication.shard_id) == ends


def test_a_small_rollout_is_answered_at_once_with_what_the_model_predicts(served: Served) -> None:
    model, controllers = tiny_model()[2], paths()
    expected = model.rollout_batch(controllers.astype(np.float32).astype(float))
    with served.client() as client:
        answer = client.post(
            "/v1/rollouts", json=body(served, controllers, returns=["points", "vertices"], every=2)
        )
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert (found["candidates"], found["ticks"], found["history"]) == (3, 16, 2)
    assert found["times"] == pytest.approx(np.arange(0, 16, 2) * model.spec.dt_s)
    vertices = EncodedArray.model_validate(found["vertices"]).numpy()
    points = EncodedArray.model_validate(found["points"]).numpy()
    assert vertices == pytest.approx(expected[:, ::2], abs=SINGLE_PRECISION_M)
    assert points == pytest.approx(model.skin.apply(expected[:, ::2]), abs=SINGLE_PRECISION_M)
    assert np.abs(points[0, -1] - points[2, -1]).max() > 5e-3


def test_nested_lists_and_one_candidate_do_as_well(served: Served) -> None:
    controllers = paths(1)[0]
    with served.client() as client:
        listed = client.post(
            "/v1/rollouts", json={"model": served.model, "controllers": controllers.tolist()}
        )
        encoded = client.post("/v1/rollouts", json=body(served, controllers))
    assert listed.status_code == 200, listed.text
    assert listed.json()["points"] == encoded.json()["points"]


def test_controls_on_another_clock_are_interpolated(served: Served) -> None:
    model, controllers = tiny_model()[2], paths(1)[0]
    times = np.arange(len(controllers)) * model.spec.dt_s
    fine_times = np.linspace(0.0, times[-1], 3 * len(times) - 2)
    fine = np.stack(
        [np.interp(fine_times, times, column) for column in controllers.reshape(len(times), -1).T], axis=1
    ).reshape(-1, *controllers.shape[1:])
    with served.client() as client:
        coarse = client.post("/v1/rollouts", json=body(served, controllers)).json()
        answer = client.post("/v1/rollouts", json=body(served, fine, times=fine_times.tolist()))
    assert answer.status_code == 200, answer.text
    found = EncodedArray.model_validate(answer.json()["points"]).numpy()
    assert found == pytest.approx(EncodedArray.model_validate(coarse["points"]).numpy(), abs=1e-5)


def test_from_rest_the_first_tick_is_the_first_that_is_asked_for(served: Served) -> None:
    start = tiny_model()[2].start_controllers[:1]
    with served.client() as client:
        still = client.post("/v1/rollouts", json=body(served, np.repeat(start, 8, axis=0), start="rest"))
    assert still.status_code == 200, still.text
    assert EncodedArray.model_validate(still.json()["points"]).shape[:2] == [1, 8]


def test_a_stiffer_body_answers_otherwise(served: Served) -> None:
    with served.client() as client:
        plain = client.post("/v1/rollouts", json=body(served, paths())).json()
        stiff = client.post("/v1/rollouts", json=body(served, paths(), stiffness_factor=3.0)).json()
    gap = np.abs(
        EncodedArray.model_validate(plain["points"]).numpy()
        - EncodedArray.model_validate(stiff["points"]).numpy()
    )
    assert gap.max() > 1e-5


def test_a_large_rollout_is_a_job_whose_artifact_is_the_same_prediction(served: Served) -> None:
    count = SYNC_STEPS // 16 + 2
    controllers = paths(count)
    with served.client() as client:
        answer = client.post("/v1/rollouts", json=body(served, controllers))
        assert answer.status_code == 202, answer.text
        job = answer.json()
        assert answer.headers["Location"] == f"/v1/jobs/{job['id']}"
        pending = client.get(job["links"]["rollout"]).json()
        assert pending["state"] == "pending"
        _work(served)
        found = client.get(job["links"]["rollout"]).json()
        assert found["state"] == "ready"
        assert found["candidates"] == count
        file = next(item for item in found["artifacts"] if item["name"] == "rollout.npz")
        data = client.get(f"/v1/artifacts/{file['sha256']}").content
        assert found["id"] in {item["id"] for item in client.get("/v1/rollouts").json()["data"]}
        assert client.get(f"/v1/jobs/{job['id']}").json()["outputs"][0]["digest"] == file["sha256"]
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        points = arrays["points"]
    model = tiny_model()[2]
    expected = model.skin.apply(model.rollout_batch(controllers[:2].astype(np.float32).astype(float)))
    assert points[:2] == pytest.approx(expected, abs=SINGLE_PRECISION_M)


def test_the_twin_answers_the_same_request_as_a_job(served: Served) -> None:
    _, twin, model = tiny_model()
    controllers = paths(2)
    with served.client() as client:
        answer = client.post(
            "/v1/rollouts", json=body(served, controllers, by="twin", returns=["points", "vertices"], every=3)
        )
        assert answer.status_code == 202, answer.text
        _work(served)
        made = client.get(answer.json()["links"]["rollout"]).json()
        assert (made["state"], made["by"]) == ("ready", "twin")
        assert [item["kind"] for item in made["lineage"]["inputs"]] == ["model", "scene", "fit"]
        found = arrays_of(client, made)
    times = model.spec.dt_s * np.arange(controllers.shape[1])
    for number, path in enumerate(controllers.astype(np.float32).astype(float)):
        nodes = twin.simulate_nodes(times, path, times)[::3]
        assert found["points"][number] == pytest.approx(twin.track_nodes(nodes), abs=SINGLE_PRECISION_M)
        vertices = twin.particles_at(nodes)[:, model.spec.particle_index]
        assert found["vertices"][number] == pytest.approx(vertices, abs=SINGLE_PRECISION_M)
    assert found["times"] == pytest.approx(times[::3])


def test_the_twin_from_rest_and_stiffer_lies_still_and_then_bends_less(served: Served) -> None:
    model = tiny_model()[2]
    still = np.repeat(model.start_controllers[:1], 10, axis=0)

    def sag(factor: float) -> np.ndarray:
        with served.client() as client:
            job = client.post(
                "/v1/rollouts", json=body(served, still, by="twin", start="rest", stiffness_factor=factor)
            ).json()
            _work(served)
            made = client.get(job["links"]["rollout"]).json()
            points = arrays_of(client, made)["points"]
        assert points.shape[:2] == (1, 10)
        return np.abs(points[0] - points[0, 0]).max(axis=(1, 2))

    soft, stiff = sag(1.0), sag(4.0)
    assert soft[0] == 0.0
    assert 0.0 < stiff[-1] < 0.8 * soft[-1]


def test_a_version_whose_twin_is_fast_is_answered_for_by_it_unless_the_network_is_asked(
    served: Served,
) -> None:
    name, _ = publish_tiny(
        served.database, served.stores.artifacts, name="tiny-rod", metrics={"predictor": "twin"}
    )
    asked = {**body(served, paths(1)), "model": name}
    phi = np.zeros((tiny_model()[2].spec.object_count, 2)).tolist()
    with served.client() as client:
        unasked = client.post("/v1/rollouts", json=asked)
        network = client.post("/v1/rollouts", json={**asked, "by": "model"})
        turned = client.post("/v1/rollouts", json={**asked, "phi": phi})
        _work(served)
        made = client.get(unasked.json()["links"]["rollout"]).json()
    assert (unasked.status_code, made["by"]) == (202, "twin")
    assert (network.status_code, network.json()["by"]) == (200, "model")
    assert (turned.status_code, turned.json()["by"]) == (200, "model")


def test_the_twin_has_no_phi(served: Served) -> None:
    phi = np.zeros((tiny_model()[2].spec.object_count, 2)).tolist()
    with served.client() as client:
        answer = client.post("/v1/rollouts", json=body(served, paths(1), by="twin", phi=phi))
    assert answer.status_code == 422
    assert "stiffness_factor" in answer.text


def test_a_part_that_is_named_twice_is_returned_once(served: Served) -> None:
    """The candidates would else stand in the answer twice, one chunk after the other."""
    with served.client() as client:
        answer = client.post("/v1/rollouts", json=body(served, paths(), returns=["points", "points"]))
    assert answer.status_code == 200, answer.text
    assert EncodedArray.model_validate(answer.json()["points"]).shape == [3, 16, 4, 3]


def test_the_same_key_gives_the_same_answer_and_another_body_is_refused(served: Served) -> None:
    with served.client() as client:
        headers = {"Idempotency-Key": "rollout-1"}
        first = client.post("/v1/rollouts", json=body(served, paths()), headers=headers)
        again = client.post("/v1/rollouts", json=body(served, paths()), headers=headers)
        other = client.post("/v1/rollouts", json=body(served, paths(2)), headers=headers)
    assert first.status_code == again.status_code == 200
    assert again.headers["Idempotent-Replayed"] == "true"
    assert first.content == again.content
    assert other.status_code == 422


@pytest.mark.parametrize(
    ("spoil", "field", "words"),
    [
        (
            lambda c: {"controllers": EncodedArray.of(np.where(c > 0.004, np.nan, c)).model_dump()},
            "controllers",
            "finite",
        ),
        (lambda c: {"controllers": EncodedArray.of(c[:, :, :3]).model_dump()}, "controllers", "4 of them"),
        (
            lambda c: {"controllers": EncodedArray.of(c[:, :3]).model_dump()},
            "controllers",
            "history alone has 3",
        ),
        (
            lambda c: {"controllers": EncodedArray.of(np.repeat(c[:1], 200, 1)).model_dump()},
            "controllers",
            "3000",
        ),
        (lambda c: {"controllers": {"shape": [2, 2, 4, 3], "data": "AAAA"}}, "controllers", "3 bytes"),
        (lambda c: {"controllers": [[1.0], [1.0, 2.0]]}, "controllers", "regular"),
        (lambda c: {"controllers": []}, "controllers", "axes"),
        (lambda c: {"dt_s": 0.01}, "dt_s", "0.0333333"),
        (lambda c: {"times": [0.0, 0.1]}, "times", "2 times"),
        (lambda c: {"times": [0.5 + 0.1 * i for i in range(16)]}, "times", "start at 0"),
        (lambda c: {"times": [*range(15), 1e308]}, "times", "1e+308 s"),
        (lambda c: {"times": [*range(15), 1e306], "mode": "job"}, "times", "1e+306 s"),
        (
            lambda c: {
                "controllers": EncodedArray.of(np.repeat(c[:1, :2], 4096, 0)).model_dump(),
                "times": [0.0, 99.0],
            },
            "times",
            "4096 candidates",
        ),
        (lambda c: {"phi": [[0.0, 0.0]]}, "phi", "(20, 2)"),
        (lambda c: {"phi": np.full((20, 2), 1e300).tolist()}, "phi", "reaches 1e+300 at [0, 0]; 10 is"),
        (
            lambda c: {"controllers": absurd(c).tolist()},
            "controllers",
            "reaches 1e+300 at [2, 5, 0, 1]; 1000 is",
        ),
        (
            lambda c: {"controllers": EncodedArray.of(c + 2000.0).model_dump(), "mode": "job"},
            "controllers",
            "; 1000 is the farthest",
        ),
        (lambda c: {"stiffness_factor": 1e9}, "stiffness_factor", "100"),
    ],
)
def test_what_cannot_be_rolled_out_is_refused_with_the_field_and_the_numbers(
    served: Served, spoil: object, field: str, words: str
) -> None:
    controllers = paths()
    with served.client() as client:
        answer = client.post("/v1/rollouts", json={**body(served, controllers), **spoil(controllers)})
    assert answer.status_code == 422, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    problem = answer.json()
    assert any(field in fault["loc"] for fault in problem["errors"]), problem
    assert words in answer.text


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ({"kind": "shape", "shape": [[0.0, 1e300, 0.0]]}, "goal.shape reaches 1e+300 at [0, 1]; 1000 is"),
        ({"kind": "points", "index": [0], "places": [[0.0, 1e300, 0.0]]}, "less than or equal to 1000"),
    ],
)
def test_a_goal_that_is_absurdly_far_is_refused(served: Served, goal: dict[str, object], words: str) -> None:
    with served.client() as client:
        answer = client.post("/v1/plans", json={"model": served.model, "goal": goal})
    assert answer.status_code == 422 and words in answer.text, answer.text


def test_few_places_of_many_candidates_are_refused_before_they_are_interpolated() -> None:
    """Two places and their times span every tick: interpolated they would fill the worker's memory."""
    asked = RolloutCreate(
        model="tiny-bar", controllers=EncodedArray.of(paths(1000)[:, :2]), times=[0.0, 60.0], mode="job"
    )
    model = tiny_model()[2]
    tracemalloc.start()
    with pytest.raises(
        ControlsInvalid, match=r"500 ticks of 0\.03333 s are the most for 1000 candidates"
    ) as refused:
        rollouts.prepare(asked, model)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert refused.value.field == "times"
    assert peak < 20e6


def test_a_prediction_that_leaves_the_numbers_says_when_after_what_was_asked_for(served: Served) -> None:
    """From rest too, where ticks of the model's history come before the first one that was asked for."""
    name, version = publish_tiny(
        served.database,
        served.stores.artifacts,
        name="tiny-wild",
        changed={"prior.weight": lambda values: 50.0 * values},
    )
    start = tiny_model()[2].start_controllers[:1]
    asked = body(served, np.repeat(start, 60, axis=0), start="rest") | {"model": name, "version": version}
    _, wild = Models(served.database, served.stores.artifacts).get(name, version)
    lead = wild.model.config.history
    rolled = wild.rollout(
        np.repeat(start, 60 + lead, axis=0).astype(np.float32).astype(float),
        history=np.repeat(wild.start_history[:1], lead + 1, axis=0),
    )
    tick = int(np.argmin((np.abs(rolled) < 10 * rollouts.FARTHEST_M).all(axis=(1, 2)))) - lead
    assert tick > 0
    with served.client() as client:
        answer = client.post("/v1/rollouts", json=asked)
    assert (answer.status_code, answer.json()["code"]) == (422, "rollout_diverged")
    assert f"candidate 0 left the numbers at {tick * wild.spec.dt_s:.3g} s" in answer.json()["detail"]


def test_unknown_models_and_readers_are_refused(served: Served) -> None:
    from physworld_storage.access import api_keys

    with served.database.session() as session:
        _, reader = api_keys.create_key(session, "reader", "read")
    with served.client() as client:
        assert (
            client.post("/v1/rollouts", json={**body(served, paths()), "model": "nobody"}).status_code == 404
        )
        assert client.post("/v1/rollouts", json={**body(served, paths()), "version": 9}).status_code == 404
    with served.client(reader) as client:
        assert client.post("/v1/rollouts", json=body(served, paths())).status_code == 403


def test_the_inference_service_answers_nobody_without_a_ticket(served: Served) -> None:
    import httpx

    asked = {**body(served, paths()), "version": served.version}
    bare = httpx.post(f"{served.inference_url}/rollouts", json=asked, trust_env=False)
    assert bare.status_code == 401


def test_a_version_of_another_layout_is_named_and_not_loaded(served: Served) -> None:
    """Nothing of it runs; who wrote it, what it lacks and what to do stand in the answer, of a job too."""
    written = {"versions": {"physworld": "physworld 0.0.7"}, "schema_version": 1, "dataset_id": "dst_old"}
    for lacking, extra, said in (
        ("prior.placing", written, "it lacks 'prior.placing'"),
        (None, written | {"schema_version": 7}, "card of layout 7"),
        (None, written | {"architecture": {}}, "it lacks 'hidden'"),
    ):
        name, version = publish_tiny(served.database, served.stores.artifacts, lacking=lacking, card=extra)
        asked = body(served, paths()) | {"model": name, "version": version}
        with served.client() as client:
            answer = client.post("/v1/rollouts", json=asked)
            job = client.post("/v1/rollouts", json=asked | {"mode": "job"}).json()
        assert answer.status_code == 409
        assert answer.headers["Content-Type"] == "application/problem+json"
        problem = answer.json()
        assert problem["code"] == "model_unreadable"
        for words in (said, "physworld 0.0.7", "Train it anew", "dst_old"):
            assert words in problem["detail"]
        _work(served, ends="failed")
        with served.client() as client:
            ended = client.get(f"/v1/jobs/{job['id']}").json()
        assert ended["state"] == "failed"
        assert ended["error"]["code"] == "model_unreadable"
