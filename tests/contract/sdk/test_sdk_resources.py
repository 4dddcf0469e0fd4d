"""The SDK against the real API: every resource, typed, through a whole pipeline."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path

import marker_files
import pytest
from physworld_client import AsyncClient, Client
from physworld_client.errors import (
    AuthenticationFailed,
    Conflict,
    ConnectionFailed,
    InvalidRequest,
    ModelUnreadable,
    NotFound,
    SceneInvalid,
)
from sdk_service import Service, write_scene

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.scene import SceneImport


def test_the_whole_chain_step_by_step(service: Service, client: Client, tmp_path: Path) -> None:
    scene = client.scenes.create(write_scene(tmp_path / "strip"))
    assert (scene.name, scene.frames, scene.points, scene.controllers) == ("strip", 20, 9, 1)
    assert client.scenes.get(scene.id) == scene

    fitting = client.fits.create(scene.id)
    assert (fitting.kind, fitting.state) == ("fit", "queued")
    service.work()
    fit = client.fits.get(client.jobs.wait(fitting, timeout=30).outputs[0].id)
    assert fit.state == "ready"
    assert fit.parameters["youngs_modulus_pa"].ci95 == (1.8e5, 2.2e5)

    writing = client.datasets.create(fit.id, DatasetConfig(episodes=7))
    service.work()
    dataset = client.datasets.get(client.jobs.wait(writing.id, timeout=30).outputs[0].id)
    assert (dataset.state, dataset.episodes_done) == ("sealed", 7)
    episodes = list(client.datasets.episodes(dataset.id, limit=3).auto_paging_iter())
    assert [episode.index for episode in episodes] == list(range(7))
    arrays = client.datasets.episode(dataset.id, 4)
    assert arrays["particles"].shape == (10, 20, 3) and (arrays["particles"] == 4).all()
    with pytest.raises(NotFound):
        client.datasets.episode(dataset.id, 7)

    training = client.models.create("strip", dataset.id, TrainingConfig(steps=1), description="first")
    with pytest.raises(ModelUnreadable, match="strip version 1 is pending"):
        client.models.download("strip", tmp_path / "early", 1)
    service.work()
    assert client.jobs.wait(training, timeout=30).outputs[0].id == "strip:1"
    assert client.models.set_alias("strip", "champion", 1).aliases == {"champion": 1}
    version = client.models.download("strip", tmp_path / "model", "champion")
    assert (version.version, version.description, version.aliases) == (1, "first", ["champion"])
    names = {path.name for path in (tmp_path / "model").iterdir()}
    assert names == {"model.safetensors", "card.json", "manifest.json", "manifest.sig.json"}
    assert hashlib.sha256((tmp_path / "model" / "manifest.json").read_bytes()).hexdigest() == version.sha256
    assert client.models.version("strip") == version
    assert client.models.get("strip").latest_version == 1
    assert [found.version for found in client.models.versions("strip").auto_paging_iter()] == [1]
    assert "strip" in {model.name for model in client.models.list().auto_paging_iter()}


def test_a_pipeline_in_one_call(service: Service, client: Client, tmp_path: Path) -> None:
    scene = client.scenes.create(write_scene(tmp_path / "whole", "whole"))
    body = PipelineCreate(scene_id=scene.id, model_name="whole-model", dataset=DatasetConfig(episodes=2))
    job = client.pipelines.create(body)
    service.work()
    done = client.jobs.wait(job, timeout=30)
    assert [reference.kind for reference in done.outputs] == ["fit", "dataset", "model"]
    assert [client.jobs.get(child).state for child in done.children] == ["succeeded"] * 3
    assert client.models.version("whole-model", 1).state == "ready"


def test_lists_are_paged_newest_first(client: Client, tmp_path: Path) -> None:
    made = [client.scenes.create(write_scene(tmp_path / f"s{n}", f"paged-{n}", seed=n)).id for n in range(5)]
    page = client.scenes.list(limit=2)
    assert len(page.data) == 2 and page.has_more
    listed = [scene.id for scene in page.auto_paging_iter() if scene.id in made]
    assert listed == made[::-1]
    second = client.scenes.list(limit=2, cursor=page.next_cursor)
    assert not {scene.id for scene in second.data} & {scene.id for scene in page.data}
    assert {job.kind for job in client.jobs.list(kind="fit").auto_paging_iter()} <= {"fit"}


def test_a_bad_scene_is_refused_with_every_fault(client: Client, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "bad")
    declared = (folder / "scene.json").read_text()
    (folder / "scene.json").write_text(declared.replace('"test": [14, 20]', '"test": [14, 99]'))
    with pytest.raises(SceneInvalid, match="99") as caught:
        client.scenes.create(folder)
    assert caught.value.status == 422
    assert caught.value.problem.errors
    assert caught.value.problem.request_id


def test_errors_are_typed(service: Service, client: Client) -> None:
    absent = "job_01ARZ3NDEKTSV4RRFFQ69G5FAV"
    with pytest.raises(NotFound, match=absent):
        client.jobs.get(absent)
    for escape in ("nonsense", "../jobs", "?limit=1", "a b"):
        with pytest.raises((InvalidRequest, NotFound)):
            client.scenes.get(escape)
    with pytest.raises(NotFound):
        client.models.version("nobody")
    with Client(service.url, "wrong", max_retries=0) as stranger, pytest.raises(AuthenticationFailed):
        stranger.scenes.list()
    with Client("http://127.0.0.1:9", max_retries=0) as lost:
        with pytest.raises(ConnectionFailed, match=r"no connection to http://127.0.0.1:9: .*1 attempt"):
            lost.scenes.list()


def test_a_finished_job_cannot_be_cancelled(service: Service, client: Client, tmp_path: Path) -> None:
    scene = client.scenes.create(write_scene(tmp_path / "late", "late"))
    job = client.fits.create(scene.id)
    service.work()
    client.jobs.wait(job, timeout=30)
    with pytest.raises(Conflict, match="succeeded"):
        client.jobs.cancel(job.id)


def test_the_asynchronous_client_does_the_same(service: Service, tmp_path: Path) -> None:
    async def chain() -> None:
        async with AsyncClient(service.url, service.token) as client:
            scene = await client.scenes.create(write_scene(tmp_path / "async", "async"))
            config = DatasetConfig(episodes=2)
            body = PipelineCreate(scene_id=scene.id, model_name="async", dataset=config)
            job = await client.pipelines.create(body)
            seen: list[str] = []
            waiting = asyncio.create_task(client.jobs.wait(job, 60, lambda job: seen.append(job.state)))
            await asyncio.to_thread(service.work)
            done = await waiting
            assert seen[-1] == "succeeded"
            assert [event.type async for event in client.jobs.events(done.id)][-1] == "state"
            [dataset] = (await client.datasets.list(limit=1)).data
            seen_episodes: list[tuple[int, int]] = []
            await client.datasets.export(
                dataset.id, tmp_path / "episodes", on_progress=lambda *at: seen_episodes.append(at)
            )
            assert seen_episodes == [(1, 2), (2, 2)]
            assert len(list((tmp_path / "episodes").glob("episode-*.npz"))) == 2
            version = await client.models.download("async", tmp_path / "out")
            assert version.name == "async"
            pages = await client.jobs.list(limit=2)
            assert done.id in {job.id async for job in pages.auto_paging_iter()}
            with pytest.raises(NotFound):
                await client.models.get("nobody")

    asyncio.run(chain())


def test_a_table_of_markers_is_looked_at_and_made_a_scene_with_options(
    client: Client, tmp_path: Path
) -> None:
    source = tmp_path / "take.csv"
    source.write_bytes(marker_files.motive(marker_files.made(frames=40)))
    found = client.scenes.preview(source, SceneImport(unit="m"))
    assert found.importer == "OptiTrack Motive CSV"
    assert {guess.option: guess.value for guess in found.guesses}["up"] == "y"
    options = SceneImport(
        kind="sheet", body={"mass_kg": 0.1, "thickness_m": 1e-3}, assume=False, name="cloth"
    )
    scene = client.scenes.create(source, options)
    assert (scene.name, scene.kind, scene.points, scene.controllers) == ("cloth", "sheet", 16, 4)
    with pytest.raises(SceneInvalid, match="its kind"):
        client.scenes.create(source, SceneImport(assume=False))
