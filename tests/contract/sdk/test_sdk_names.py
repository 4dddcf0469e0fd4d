"""Names and beginnings of ids in the place of ids, in both halves of the SDK, against the real API."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from physworld_client import AmbiguousName, AsyncClient, Client, NotFound, UnknownName, names
from sdk_service import Service, write_scene

from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig


@pytest.fixture(scope="module")
def scene_id(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("scenes")
    with service.client() as client:
        client.scenes.create(write_scene(folder / "rope", "rope one", seed=1))
        return client.scenes.create(write_scene(folder / "strip", "strip", seed=2)).id


@contextmanager
def counted(client: Client) -> Iterator[list[str]]:
    """The paths that are asked for in the block."""
    paths: list[str] = []
    hook = [lambda request: paths.append(request.url.path)]
    before, client.http.event_hooks = client.http.event_hooks, {"request": hook, "response": []}
    yield paths
    client.http.event_hooks = before


def test_a_scene_is_got_by_its_name_with_one_request_more_and_by_its_id_with_none(
    client: Client, scene_id: str
) -> None:
    for given in ("strip", scene_id[:-1], scene_id[:-1].lower(), scene_id.removeprefix("scn_")[:-1]):
        with counted(client) as paths:
            assert client.scenes.get(given).id == scene_id
        assert paths == ["/v1/scenes", f"/v1/scenes/{scene_id}"]
    with counted(client) as paths:
        assert client.scenes.get(scene_id).id == scene_id
    assert paths == [f"/v1/scenes/{scene_id}"]


def test_what_fits_several_or_nothing_is_told_with_what_was_perhaps_meant(
    client: Client, scene_id: str
) -> None:
    with pytest.raises(AmbiguousName, match=r"2 scenes fit 'scn_': scn_\w+, scn_\w+") as several:
        client.scenes.get("scn_")
    assert len(several.value.candidates) == 2 and several.value.candidates[0] == scene_id
    said = rf"no scene is called 'strap' and no id begins so; the nearest: strip \({scene_id}\)$"
    with pytest.raises(UnknownName, match=said) as nothing:
        client.fits.create("strap")
    assert nothing.value.candidates == (scene_id,) and isinstance(nothing.value, NotFound)
    with pytest.raises(
        UnknownName, match=r"no scene is called 'Q' .*; the newest: strip \(scn_\w+\), rope one"
    ):
        client.scenes.get("Q")
    with pytest.raises(UnknownName, match=r"no plan is called 'pln_' .*; there is none$"):
        client.plans.get("pln_")


def test_every_call_that_takes_an_id_takes_a_name(service: Service, client: Client, scene_id: str) -> None:
    fitting = client.fits.create("strip")
    service.work()
    fit_id = client.jobs.wait(fitting.id[:-1], timeout=30).outputs[0].id
    assert client.fits.get(fit_id[:-1]).scene_id == scene_id

    writing = client.datasets.create(fit_id[4:-1])
    service.work()
    dataset_id = client.jobs.get(writing.id[:-1]).outputs[0].id
    assert client.datasets.episodes(dataset_id[:-1], limit=1).data[0].index == 0
    assert client.datasets.episode(dataset_id[:-1], 0)["particles"].shape == (10, 20, 3)
    assert [event.type for event in client.jobs.events(writing.id[:-1])][-1] == "state"

    training = client.models.create("named", dataset_id[:-1])
    service.work()
    assert client.jobs.get(training.id).outputs[0].id == "named:1"
    with pytest.raises(NotFound, match="nam"):
        client.models.get("nam")
    assert client.models.id_of("nam") == "named"

    assert client.checks.create("strip").kind == "check"
    assert client.traces.create("strip", TraceConfig(), fit_id=fit_id[:-1]).kind == "trace"
    service.work()
    assert [check.scene_id for check in client.checks.list(scene_id="strip").data] == [scene_id]
    assert [trace.scene_id for trace in client.traces.list(scene_id="strip").data] == [scene_id]
    assert client.videos.create("scene", "strip").kind == "video"
    assert client.jobs.cancel(client.pipelines.create(scene_id="strip").id[4:]).kind == "pipeline"
    assert client.pipelines.create(PipelineCreate(scene_id="strip")).kind == "pipeline"
    key = client.keys.create("robot")
    assert client.keys.revoke("robot").id == key.id


def test_the_asynchronous_half_takes_names_too(service: Service, scene_id: str) -> None:
    async def got() -> str:
        async with AsyncClient(service.url, service.token) as client:
            return (await client.scenes.get("strip")).id

    assert asyncio.run(got()) == scene_id


def test_many_objects_are_looked_through_page_by_page(
    client: Client, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(names, "PAGE", 1)
    with counted(client) as paths:
        assert client.scenes.id_of("rope one") != scene_id
    assert paths == ["/v1/scenes", "/v1/scenes"]
    monkeypatch.setattr(names, "MOST", 1)
    with pytest.raises(UnknownName, match="no id begins so among the newest 1; the newest: strip"):
        client.scenes.id_of("rope one")


def test_a_picture_is_put_beside_a_scene_by_name(client: Client, scene_id: str, tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="nearest: strip"):
        client.videos.put_picture("strp", tmp_path / "splat.ply")
