"""Models, versions that only grow, aliases that move, and the other resources in pages."""

from __future__ import annotations

import base64
import json
import threading
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import TypeAdapter

from physworld_schemas.base import Lineage, Page
from physworld_schemas.model import TrainingConfig
from physworld_schemas.scene import Scene
from physworld_storage import registry, resources
from physworld_storage.errors import Conflict, InvalidCursor, NotFound, ResultInvalid
from physworld_storage.jobs.kinds import parse_result

if TYPE_CHECKING:
    from conftest import Work

    from physworld_storage.database import Database


DIVERGED = {"held_out": {"track_m": {"static": 0.1, "rigid_follow": 0.014, "world_model_finetuned": 0.752}}}


def publish(
    database: Database, name: str, *, ready: bool = True, metrics: dict[str, Any] | None = None
) -> int:
    with database.session() as session:
        row = registry.allot_version(session, name, config=TrainingConfig())
        if ready:
            lineage = Lineage()
            registry.publish(
                session,
                name,
                row.version,
                artifacts=[],
                sha256="e" * 64,
                metrics=metrics or {},
                lineage=lineage,
            )
        return row.version


def test_versions_allotted_at_once_are_all_different(database: Database) -> None:
    barrier = threading.Barrier(6)
    versions: list[int] = []

    def allot() -> None:
        barrier.wait()
        versions.append(publish(database, "beam"))

    threads = [threading.Thread(target=allot) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(versions) == [1, 2, 3, 4, 5, 6]


def test_a_ready_version_is_immutable(database: Database) -> None:
    version = publish(database, "beam")
    with database.session() as session, pytest.raises(Conflict, match="is ready"):
        registry.publish(
            session, "beam", version, artifacts=[], sha256="f" * 64, metrics={}, lineage=Lineage()
        )
    with database.session() as session:
        registry.end_version(session, "beam", version, "failed", "too late")
        assert registry.get_version(session, "beam", version).state == "ready"


def test_latest_is_the_newest_that_is_ready(database: Database) -> None:
    publish(database, "beam")
    publish(database, "beam", ready=False)
    with database.reading() as session:
        assert registry.get_version(session, "beam", "latest").version == 1
        assert registry.get_version(session, "beam", "2").state == "pending"
        assert registry.get_model(session, "beam").latest_version == 2
    publish(database, "rope", ready=False)
    with database.reading() as session, pytest.raises(NotFound, match="no ready version of model rope"):
        registry.get_version(session, "rope", "latest")


def test_a_version_that_fails_the_quality_gate_is_ready_and_not_latest(database: Database) -> None:
    good = publish(database, "beam")
    bad = publish(database, "beam", metrics=DIVERGED)
    with database.reading() as session:
        assert registry.get_version(session, "beam", "latest").version == good
        assert registry.get_model(session, "beam").latest == good
        marked = registry.get_version(session, "beam", bad)
    assert (marked.state, marked.quality.verdict) == ("ready", "failed")
    with database.session() as session:  # whoever means it may still point an alias at it
        registry.set_alias(session, "beam", "champion", bad)
    following = publish(database, "beam")
    with database.reading() as session:
        assert registry.get_version(session, "beam", "latest").version == following


def test_a_model_all_of_whose_versions_fail_the_gate_has_no_latest(database: Database) -> None:
    publish(database, "beam", metrics=DIVERGED)
    with database.reading() as session:
        assert registry.get_model(session, "beam").latest is None
        with pytest.raises(Conflict, match=r"version 1, the newest that is ready, .*752 mm"):
            registry.get_version(session, "beam", "latest")


def test_an_alias_moves(database: Database) -> None:
    first, second = publish(database, "beam"), publish(database, "beam")
    for version in (first, second, first):
        with database.session() as session:
            assert registry.set_alias(session, "beam", "champion", version).aliases == {"champion": version}
    with database.reading() as session:
        assert registry.get_version(session, "beam", "champion").aliases == ["champion"]
        assert registry.get_version(session, "beam", second).aliases == []
    with database.session() as session:
        assert registry.delete_alias(session, "beam", "champion").aliases == {}
    with database.session() as session, pytest.raises(NotFound, match="beam@champion"):
        registry.delete_alias(session, "beam", "champion")


@pytest.mark.parametrize("alias", ["latest", "3", "", "Champion", "a" * 40, "a/b"])
def test_an_alias_that_could_be_mistaken_is_refused(database: Database, alias: str) -> None:
    version = publish(database, "beam")
    with database.session() as session, pytest.raises(Conflict, match="cannot be an alias"):
        registry.set_alias(session, "beam", alias, version)


def test_an_alias_needs_a_ready_version(database: Database) -> None:
    version = publish(database, "beam", ready=False)
    with database.session() as session, pytest.raises(Conflict, match="needs a ready version"):
        registry.set_alias(session, "beam", "champion", version)


def test_models_and_versions_come_in_pages_newest_first(database: Database) -> None:
    for name in ("a", "b", "c"):
        publish(database, name)
        publish(database, name)
    with database.reading() as session:
        first = registry.list_models(session, limit=2)
        second = registry.list_models(session, limit=2, cursor=first.next_cursor)
        versions = registry.list_versions(session, "b", limit=1)
        older = registry.list_versions(session, "b", limit=1, cursor=versions.next_cursor)
        with pytest.raises(NotFound, match="no model d"):
            registry.list_versions(session, "d")
    assert [model.name for model in first.data + second.data] == ["c", "b", "a"]
    assert [version.version for version in versions.data + older.data] == [2, 1]


@pytest.mark.parametrize(
    "cursor", ["", "x", "bm9uc2Vuc2U", "WzEsMl0", "WyJ5ZXN0ZXJkYXkiLCAieCJd", "\u00e4", "bnVsbA"]
)
def test_a_cursor_from_elsewhere_is_refused(work: Work, cursor: str) -> None:
    with work.database.reading() as session, pytest.raises(InvalidCursor):
        resources.list_scenes(session, cursor=cursor)


@pytest.mark.parametrize(
    "keys",
    [
        ["2026-01-01T00:00:00+00:00", "\ud800"],
        ["0001-01-01T00:00:00+23:59", "scn_a"],
        ["2026-01-01", "scn_a"],
    ],
)
def test_a_cursor_that_no_database_compares_is_refused(work: Work, keys: list[str]) -> None:
    with work.database.reading() as session, pytest.raises(InvalidCursor):
        resources.list_scenes(session, cursor=base64.urlsafe_b64encode(json.dumps(keys).encode()).decode())


def test_a_number_too_large_for_its_column_is_no_cursor_and_no_version(work: Work) -> None:
    publish(work.database, "beam")
    with work.database.reading() as session:
        for number in (2**31, -(2**31), 2**70):
            cursor = base64.urlsafe_b64encode(f"[{number}]".encode()).decode()
            with pytest.raises(InvalidCursor):
                registry.list_versions(session, "beam", cursor=cursor)
        for digits in ("9" * 10, "9" * 5000):
            with pytest.raises(NotFound, match="beam:999999999"):
                registry.get_version(session, "beam", digits)


def test_a_page_does_not_shift_under_writers(work: Work) -> None:
    made = [work.scene().id for _ in range(4)]
    with work.database.reading() as session:
        first = resources.list_scenes(session, limit=2)
    work.scene()
    with work.database.reading() as session:
        second = resources.list_scenes(session, limit=2, cursor=first.next_cursor)
    assert [scene.id for scene in first.data + second.data] == made[::-1]
    assert TypeAdapter(Page[Scene]).validate_python(second).data == second.data


def test_the_same_bundle_is_the_same_scene(work: Work) -> None:
    scene = work.scene("one name")
    work._scenes = 0
    assert work.scene("another name") == scene


def test_episodes_are_listed_by_index(work: Work) -> None:
    job = work.dataset(episodes=5)
    work.complete(work.claim())
    for shard_id in reversed(work.waiting()):
        work.complete(work.claim(shard_id))
    dataset_id = job.outputs[0].id
    with work.database.reading() as session:
        first = resources.list_episodes(session, dataset_id, limit=3)
        second = resources.list_episodes(session, dataset_id, limit=3, cursor=first.next_cursor)
        assert resources.get_episode(session, dataset_id, 4).seed == 2**62 + 4
        with pytest.raises(NotFound, match=f"{dataset_id}/5"):
            resources.get_episode(session, dataset_id, 5)
    assert [episode.index for episode in first.data + second.data] == [0, 1, 2, 3, 4]


def test_filters_of_the_lists(work: Work) -> None:
    done = work.finish(work.pipeline(episodes=1))
    work.fit()
    fit_id, dataset_id = done.outputs[0].id, done.outputs[1].id
    with work.database.reading() as session:
        scene_id = resources.get_fit(session, fit_id).scene_id
        assert [fit.id for fit in resources.list_fits(session, state="ready").data] == [fit_id]
        assert [fit.id for fit in resources.list_fits(session, scene_id=scene_id).data] == [fit_id]
        found = resources.list_datasets(session, state="sealed", fit_id=fit_id, scene_id=scene_id)
        assert [dataset.id for dataset in found.data] == [dataset_id]
        assert resources.list_datasets(session, fit_id="fit_none").data == []
        assert resources.list_scenes(session, kind="rope").data == []


@pytest.mark.parametrize(
    ("kind", "result", "fault"),
    [
        ("fit", {}, "parameters: Field required; metrics: Field required; artifacts: Field required"),
        ("dataset_plan", {"episodes": 30_000, "frames": 1, "particles": 1}, "less than or equal to 20000"),
        ("dataset_seal", {"digest": "short", "artifacts": []}, "digest: String should match"),
        (
            "training",
            {"artifacts": [], "sha256": "e" * 64, "metrics": {"a": [1, float("inf")]}},
            r"a\[1\] is inf",
        ),
        ("training", {"artifacts": [], "sha256": "e" * 64, "metrics": {"a": {1, 2}}}, "not JSON"),
    ],
)
def test_a_result_of_the_wrong_form_says_what_is_wrong(
    kind: str, result: dict[str, object], fault: str
) -> None:
    with pytest.raises(ResultInvalid, match=fault):
        parse_result(kind, 0, result)
