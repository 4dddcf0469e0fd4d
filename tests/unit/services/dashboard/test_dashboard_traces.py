"""The pages of a trace and of an assessment over HTTP: verdict, figures, path, overlay, and the report's cage."""

from __future__ import annotations

import html
import io
import json
import re
from typing import Any

import httpx
import numpy as np
import pytest
from dashboard_served import Served, from_page, work
from sqlalchemy import select
from tiny_scene import register, tiny_scene

from physworld_schemas.base import Artifact, Problem
from physworld_schemas.fit import FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_services.stores import Stores
from physworld_storage.jobs import jobs, leases
from physworld_storage.tables import AssessmentRow, ModelRow, ModelVersionRow, ShardRow, utc_now

pytestmark = pytest.mark.slow

REPORT: dict[str, Any] = {
    "scene": "tiny bar",
    "verdict": "named",
    "reason": "best supported among 25 candidates: air_drag_linear; misfit 5.10 to 1.04 of the noise",
    "effects": [
        {
            "name": "air_drag_linear",
            "title": "drag",
            "parameters": {"rate_per_s": {"value": 1.48, "ci95": [1.4, 1.55], "unit": "1/s"}},
        }
    ],
    "equivalent": [],
    "candidates": [
        {"name": "wind", "score": 0.01, "threshold": 0.03, "selected": False},
        {"name": "air_drag_linear", "score": 0.61, "threshold": 0.03, "selected": True},
        {"name": "tether", "score": None, "threshold": 0.03, "selected": False},
    ],
    "path": [
        {
            "base": [],
            "tried": [{"effects": ["air_drag_linear"], "misfit": 1.04, "left_out_error": 1.1, "values": {}}],
            "kept": ["air_drag_linear"],
        }
    ],
    "held_out": {
        "before": 0.0081,
        "after": 0.00104,
        "after_ci95": [0.001, None],
        "noise_floor": 0.001,
        "explained_fraction": 0.99,
        "baselines": {"static": 0.05},
    },
    "unexplained": {"rms_m": 1e-4, "description": "nothing above <the> noise"},
    "suggested_experiment": None,
}


@pytest.fixture
def client(dashboard: Served) -> httpx.Client:
    return dashboard.client


def _files(stores: Stores) -> list[dict[str, Any]]:
    scene = tiny_scene()
    buffer = io.BytesIO()
    np.savez(buffer, times=scene.times, before=scene.points + 0.01, after=scene.points)
    contents = {"report.json": json.dumps(REPORT).encode(), "tracks.npz": buffer.getvalue()}
    contents["report.html"] = b"<!doctype html><script>alert(1)</script>"
    put = stores.artifacts.put_bytes
    return [put(content, name).model_dump() for name, content in contents.items()]


@pytest.fixture
def trace_id(dashboard: Served) -> str:
    """A ready trace, and a pending one beside it."""
    database, stores = dashboard.database, dashboard.stores
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        job = jobs.create_trace(session, TraceCreate(scene_id=scene_id))
    work(database, lambda lease: {"verdict": "named", "report": REPORT, "artifacts": _files(stores)})
    with database.session() as session:
        jobs.create_trace(session, TraceCreate(scene_id=scene_id))
    return job.outputs[0].id


def test_the_page_of_a_trace_shows_the_verdict_the_errors_and_the_path(
    client: httpx.Client, trace_id: str
) -> None:
    page = client.get(f"/dashboard/traces/{trace_id}")
    assert page.status_code == 200
    for text in ("best supported among 25 candidates", "8.10", "1.04", "1.4 to 1.55", "99 %", "tether"):
        assert text in page.text, text
    assert "nothing above &lt;the&gt; noise" in page.text
    assert page.text.index("air drag linear") < page.text.index("tether")
    assert f'href="/dashboard/traces/{trace_id}/report"' in page.text
    listed = client.get("/dashboard/traces").text
    assert trace_id in listed and "pending" in listed
    scene_id = listed.partition("/dashboard/scenes/")[2].partition('"')[0]
    assert trace_id in client.get(f"/dashboard/scenes/{scene_id}").text


def test_the_overlay_and_the_curve_compare_before_with_after(client: httpx.Client, trace_id: str) -> None:
    plot = client.get(f"/dashboard/traces/{trace_id}/curve").text
    [told] = re.findall(r'data-series="([^"]*)"', plot)
    errors = {line["label"]: line["values"] for line in json.loads(html.unescape(told))}
    assert max(errors["after"]) < 1e-3
    assert min(errors["before"]) == pytest.approx(10 * 3**0.5, rel=1e-3)
    cloud = client.get(f"/dashboard/traces/{trace_id}/cloud").json()
    names = [layer["name"] for layer in cloud["layers"]]
    assert {"before", "after"} < set(names)
    layer = client.get(f"/dashboard/traces/{trace_id}/cloud/after")
    assert len(layer.content) == 4 * tiny_scene().points.size


def test_the_report_runs_in_a_cage_and_everything_else_under_the_usual_policy(
    client: httpx.Client, trace_id: str
) -> None:
    page = client.get(f"/dashboard/traces/{trace_id}/report")
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;") and "allow-same-origin" not in policy
    assert page.headers["cache-control"] == "no-store"
    usual = client.get(f"/dashboard/traces/{trace_id}").headers["content-security-policy"]
    assert "unsafe-inline" not in usual and "script-src 'self'" in usual


def test_what_is_not_there_yet_is_said(dashboard: Served, trace_id: str) -> None:
    database, client = dashboard.database, dashboard.client
    with database.reading() as session:
        pending = jobs.list_jobs(session, kind="trace", state="queued").data[0].outputs[0].id
    page = client.get(f"/dashboard/traces/{pending}")
    assert page.status_code == 200 and "under way" in page.text
    for part in ("report", "curve", "cloud"):
        assert client.get(f"/dashboard/traces/{pending}/{part}").status_code == 404
    assert client.get("/dashboard/traces/trc_none").status_code == 404


def test_a_failed_job_has_a_button_that_retries_it(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    with database.session() as session:
        job = jobs.create_fit(session, register(tiny_scene(), database, stores.artifacts), FitConfig())
    page = f"/dashboard/jobs/{job.id}"
    assert "/retry" not in client.get(page).text
    with database.session() as session:
        for shard in session.scalars(select(ShardRow).where(ShardRow.job_id == job.id)):
            lease = leases.claim(session, shard.id, "test", 30.0)
            assert lease is not None
            leases.fail(session, lease, Problem(title="Boom", status=500, code="boom"), retry=False)
    assert f'action="{page}/retry"' in client.get(page).text
    own = from_page(client)
    assert client.post(f"{page}/retry", headers=own).status_code == 303
    with database.reading() as session:
        assert jobs.get_job(session, job.id).state == "queued"


def test_what_was_cancelled_is_not_shown_as_failed(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig())
        trace = jobs.create_trace(session, TraceCreate(scene_id=scene_id))
    with database.session() as session:
        for job in (fit, trace):
            jobs.cancel_job(session, job.id)
    for path in ("fits?state=cancelled", "traces?state=cancelled", f"traces/{trace.outputs[0].id}"):
        page = client.get(f"/dashboard/{path}").text
        assert '<span class="badge cancelled">cancelled</span>' in page
        assert "badge failed" not in page
    assert "The trace was cancelled" in page


def test_a_pipeline_that_closes_the_loop_shows_the_stage(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        plain = jobs.create_pipeline(session, PipelineCreate(scene_id=scene_id))
    assert "<span>Trace</span>" not in client.get("/dashboard/").text
    with database.session() as session:
        jobs.cancel_job(session, plain.id)
        jobs.create_pipeline(session, PipelineCreate(scene_id=scene_id, close_the_loop=True))
    assert "<span>Trace</span>" in client.get("/dashboard/").text


def test_the_page_of_an_assessment_says_how_much_and_where_it_is_traced(
    dashboard: Served, trace_id: str
) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene_id = register(tiny_scene(), database, stores.artifacts)
    figure = {"error_m": 9e-3, "ci95_m": [8e-3, 1e-2], "noise_floor_m": 1e-3, "frames": 40}
    with database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig())
        session.add(ModelRow(name="bar", created_at=utc_now(), last_version=1))
        session.flush()
        blank = {"message": "", "description": "", "tags": [], "config": {}, "lineage": {}, "artifacts": []}
        closed = {"trace_id": trace_id, "statement": "The twin carries drag", "baseline_version": None}
        closed["twin"] = {"before_m": 8e-3, "after_m": 2e-3, "gain_ci95_m": [5e-3, 7e-3]}
        row = {"state": "ready", "created_at": utc_now(), "metrics": {"closed_loop": closed}, **blank}
        session.add(ModelVersionRow(name="bar", version=1, scene_id=scene_id, **row))
        session.flush()
        figures = {
            "outcome": "worse_than_expected",
            "reason": "The model errs more than noise and its card allow",
            "measured": figure,
            "expected": {**figure, "error_m": 3e-3},
            "excess_m": 6e-3,
            "excess_ci95_m": [5e-3, 7e-3],
            "baselines_m": {"static": None},
            "twin_m": 4e-3,
        }
        made = {"state": "ready", "created_at": utc_now(), "config": {}, "lineage": {}, "trace_id": trace_id}
        place = {"name": "bar", "version": 1, "scene_id": scene_id, "job_id": job.id}
        session.add(AssessmentRow(id="ass_x", figures=figures, **place, **made))
    page = client.get("/dashboard/assessments/ass_x").text
    for text in ("worse than expected", "The model errs more", "9.00", f"/dashboard/traces/{trace_id}"):
        assert text in page, text
    version = client.get("/dashboard/models/bar/1").text
    assert "The twin carries drag" in version and "gain 5.00 to 7.00" in version


def test_artifacts_of_a_trace_are_files_to_download(dashboard: Served, trace_id: str) -> None:
    files = [Artifact.model_validate(item) for item in _files(dashboard.stores)]
    page = dashboard.client.get(f"/dashboard/traces/{trace_id}").text
    assert all(file.sha256 in page for file in files)


def test_the_page_of_a_fit_says_what_the_engine_itself_does(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        fit_id = jobs.create_fit(session, scene_id, FitConfig()).outputs[0].id
    numerics = {
        "equivalent_drag_per_s": 0.0612, "damping_ratio": 0.00125, "dominant_mode_hz": 7.7, "lost_share": 0.01,
        "time_step_s": 1e-4, "half_step_m": 2e-6, "finer_cells_m": 4.2e-4, "refinement": 1.5, "particles": 2000,
        "finer_particles": 6750, "simulations": 4, "seconds": 3.0,
    }  # fmt: skip
    modulus = {"value": 2.0e5, "unit": "Pa", "ci95": [1.9e5, 2.1e5]}
    metrics = {
        "numerics": numerics,
        "converged": {"E": modulus | {"value": 2.04e5}},
        "search": {"converged": False, "open": {"E": "the search had not converged on it"}},
        "notes": ["a clamp of 4 markers"],
    }
    work(database, lambda lease: {"parameters": {"E": modulus}, "metrics": metrics, "artifacts": []}, most=1)
    page = client.get(f"/dashboard/fits/{fit_id}", follow_redirects=True).text
    for text in (
        "0.0612 1/s", "7.7 Hz", "0.420 mm", "6,750", "204,000", "not converged: E, the search", "a clamp of 4 markers",
    ):  # fmt: skip
        assert text in page, text


def test_the_page_of_a_fit_that_its_budget_cut_short_gives_no_interval_and_says_why(
    dashboard: Served,
) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        fit_id = jobs.create_fit(session, scene_id, FitConfig(max_simulations=40)).outputs[0].id
    note = "the search was cut short by its budget of 40 simulations: the best found so far, no interval"
    modulus = {"value": 2.0e5, "unit": "Pa", "ci95": None, "identified": False, "note": note}
    metrics = {
        "numerics": None,
        "converged": None,
        "not_measured": "converged: there is no optimum to extrapolate",
        "search": {"converged": False, "open": {"E": note}},
        "notes": [],
    }
    work(database, lambda lease: {"parameters": {"E": modulus}, "metrics": metrics, "artifacts": []}, most=1)
    page = client.get(f"/dashboard/fits/{fit_id}", follow_redirects=True).text
    for text in (note, "not known", "not converged: E, the search was cut short", "there is no optimum"):
        assert text in page, text
    assert "held at its prior" not in page
