"""Words over lists, and the family of a scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import select

from physworld_schemas.base import Page
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_storage import overview, registry, resources, traces
from physworld_storage.access import api_keys
from physworld_storage.database import Database
from physworld_storage.family import ancestors, family_of, related
from physworld_storage.jobs import jobs
from physworld_storage.tables import FitRow, ModelVersionRow

if TYPE_CHECKING:
    from conftest import Work


@pytest.fixture
def rope(work: Work) -> Job:
    """A finished fit of a scene called red rope, beside the whole chain of a soft beam."""
    work.finish(work.pipeline(episodes=1))
    scene = work.scene("red rope 50%_x")
    with work.database.session() as session:
        job = jobs.create_fit(session, scene.id, FitConfig())
    return work.finish(job)


def found(database: Database, listed: Callable[..., Page[object]], text: str) -> list[str]:
    with database.reading() as session:
        return [str(getattr(item, "id", None) or item.name) for item in listed(session, search=text).data]  # type: ignore[attr-defined]


def test_a_scene_is_found_by_words_of_its_name_in_any_case_and_order(database: Database, rope: Job) -> None:
    scene = rope.inputs[0].id
    for text in ("rope", "ROPE red", scene, scene[-6:], "50%", "%_x", "rope beam", "rope  "):
        assert found(database, resources.list_scenes, text) == [scene], text  # its kind is beam
    assert found(database, resources.list_scenes, "rope cloth") == []
    assert found(database, resources.list_scenes, "5_%") == []  # no wildcards
    assert len(found(database, resources.list_scenes, "")) == 2


def test_what_was_made_of_a_scene_is_found_by_its_name(database: Database, rope: Job) -> None:
    fit = rope.outputs[0].id
    assert found(database, resources.list_fits, "rope ready") == [fit]
    assert found(database, resources.list_fits, "rope failed") == []
    assert found(database, overview.list_top_jobs, "red rope") == [rope.id]
    assert found(database, overview.list_top_jobs, f"fit {fit}") == [rope.id]
    assert len(found(database, overview.list_top_jobs, "pipeline")) == 1
    assert len(found(database, resources.list_datasets, "soft sealed")) == 1
    assert found(database, traces.list_traces, "soft") == []


def test_models_and_keys_are_found_by_name(database: Database, rope: Job) -> None:
    assert len(found(database, registry.list_models, "beam")) == 1
    assert found(database, registry.list_models, "rope") == []
    with database.session() as session:
        api_keys.create_key(session, "robot arm", "read")
    assert len(found(database, api_keys.list_keys, "robot read")) == 1
    assert found(database, api_keys.list_keys, "robot admin") == []


def test_a_page_of_what_was_found_goes_on_with_the_cursor(database: Database, work: Work) -> None:
    for _ in range(3):
        work.scene("wanted")
        work.scene("other")
    with database.reading() as session:
        first = resources.list_scenes(session, limit=2, search="wanted")
        second = resources.list_scenes(session, limit=2, search="wanted", cursor=first.next_cursor)
    assert [len(first.data), len(second.data), second.has_more] == [2, 1, False]


def test_the_family_of_a_scene_leads_from_the_recording_to_the_version(
    database: Database, work: Work
) -> None:
    job = work.finish(work.pipeline(episodes=1))
    scene = job.inputs[0].id
    with database.session() as session:
        other = jobs.create_fit(session, scene, FitConfig()).outputs[0].id
    with database.reading() as session:
        members = family_of(session, scene)
        assert family_of(session, "scn_unknown") == []
    kinds = {member.kind: member for member in members if member.key != other}
    assert list(kinds) == ["scene", "fit", "dataset", "model"]
    assert kinds["fit"].parents == (scene,)
    assert kinds["dataset"].parents == (kinds["fit"].key,)
    assert kinds["model"].parents == (kinds["dataset"].key,)

    version = kinds["model"].key
    assert [member.kind for member in related(members, version)] == ["scene", "fit", "dataset", "model"]
    assert [member.key for member in related(members, other)] == [scene, other]
    assert related(members, "unknown") == members
    assert ancestors(members, kinds["dataset"].key) == {scene, kinds["fit"].key, kinds["dataset"].key}


def test_the_family_says_of_a_ready_fit_and_version_what_is_wrong_with_them(
    database: Database, work: Work
) -> None:
    scene = work.finish(work.pipeline(episodes=1)).inputs[0].id
    with database.session() as session:
        fit, version = session.scalars(select(FitRow)).one(), session.scalars(select(ModelVersionRow)).one()
        fit.metrics = {"search": {"converged": False}}
        version.metrics = {"held_out": {"track_m": {"world_model": 0.02, "static": 0.01}}}
        assert version.state == "ready"
    with database.reading() as session:
        standing = {member.kind: member.state for member in family_of(session, scene)}
    assert (standing["fit"], standing["model"]) == ("not converged", "failed the gate")
    with database.session() as session:
        session.scalars(select(FitRow)).one().metrics = {"search": {"converged": True}}
    with database.reading() as session:
        assert {m.kind: m.state for m in family_of(session, scene)}["fit"] == "ready"
