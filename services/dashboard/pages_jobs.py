"""The overview of jobs, a job's page, their live streams, and the buttons that cancel or retry a job."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from physworld_schemas.base import Reference
from physworld_schemas.job import TERMINAL_STATES, Event, Job
from physworld_services.dashboard import live
from physworld_services.dashboard.access import actor_of, require_same_origin, require_writer
from physworld_services.dashboard.curves import training_charts
from physworld_services.dashboard.lists import Asked, Looked
from physworld_services.dashboard.samples import sample_folder
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.text import progress_told
from physworld_storage import loops, overview
from physworld_storage.access import audit
from physworld_storage.jobs import events, jobs

PAGE_SIZE = 20
EVENTS_SHOWN = 100
STAGES = {
    "pipeline": ("fit", "trace", "dataset", "training"),
    "loop": ("assessment", "trace", "dataset", "training"),
}
"""Of jobs that consist of others: the kinds of these."""
FILTERS = ("all", "running", "queued", "succeeded", "failed", "cancelled")


@dataclass(frozen=True)
class Entry:
    """A job of the list, what it is about, and the children of one that consists of others."""

    job: Job
    subject: str
    children: list[Job] = field(default_factory=list)

    @property
    def stages(self) -> tuple[str, ...]:
        """Kinds of the children that are there or may follow, in their order; empty where the job has none."""
        every = STAGES.get(self.job.kind, ())
        traced = self.job.kind != "pipeline" or self.job.config.get("close_the_loop", False)
        there = {child.kind for child in self.children}
        ended = self.job.state in TERMINAL_STATES
        return tuple(
            kind for kind in every if kind in there or not (ended or (kind == "trace" and not traced))
        )


def router(site: Site) -> APIRouter:
    """Pages below the dashboard's root and ``/jobs``."""
    routes = APIRouter()

    @routes.get("/")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        live_url = f"{BASE}/live/jobs?{asked.address}"
        return site.page(request, "jobs.html", live_url=live_url, **_list(site, asked))

    @routes.get("/live/jobs")
    async def live_list(request: Request, asked: Asked) -> Response:
        def render() -> tuple[str, bool]:
            return site.fragment(request, "_jobs.html", **_list(site, asked)), False

        return await live.stream(render)

    @routes.get("/jobs/{job_id}")
    def page(request: Request, job_id: str) -> HTMLResponse:
        return site.page(request, "job.html", **_job(site, job_id))

    @routes.get("/live/jobs/{job_id}")
    async def live_page(request: Request, job_id: str) -> Response:
        def render() -> tuple[str, bool]:
            context = _job(site, job_id)
            return site.fragment(request, "_job.html", **context), context["job"].state in TERMINAL_STATES

        return await live.stream(render)

    @routes.post(
        "/jobs/{job_id}/cancel", dependencies=[Depends(require_same_origin), Depends(require_writer)]
    )
    def cancel(request: Request, job_id: str) -> Response:
        with site.database.session() as session:
            jobs.cancel_job(session, job_id)
            audit.record(session, actor_of(request), "job.cancelled", job_id)
        return RedirectResponse(f"{BASE}/jobs/{job_id}", 303)

    @routes.post("/jobs/{job_id}/retry", dependencies=[Depends(require_same_origin), Depends(require_writer)])
    def retry(request: Request, job_id: str) -> Response:
        with site.database.session() as session:
            jobs.retry_job(session, job_id)
            audit.record(session, actor_of(request), "job.retried", job_id)
        return RedirectResponse(f"{BASE}/jobs/{job_id}", 303)

    return routes


def _list(site: Site, asked: Looked) -> dict[str, Any]:
    with site.database.reading() as session:
        counts = overview.count_objects(session)
        page = overview.list_top_jobs(
            session, limit=PAGE_SIZE, cursor=asked.cursor, state=asked.state, search=asked.q
        )
        children = overview.children_of(session, page.data)
        subjects = overview.subjects_of(session, page.data)
    return {
        "counts": [
            ("active jobs", counts.active_jobs, ""),
            ("scenes", counts.scenes, "/scenes"),
            ("datasets", counts.datasets, "/datasets"),
            ("models", counts.models, "/models"),
        ],
        "entries": [Entry(job, subjects.get(job.id, ""), children.get(job.id, [])) for job in page.data],
        "filters": FILTERS,
        "has_sample": sample_folder() is not None,
        **asked.context(page.next_cursor),
    }


def _job(site: Site, job_id: str) -> dict[str, Any]:
    with site.database.reading() as session:
        job = jobs.get_job(session, job_id)
        children = overview.children_of(session, [job]).get(job_id, [])
        family = {item.id: item for item in (job, *children)}
        latest = overview.latest_events(session, list(family), EVENTS_SHOWN)
        subject = overview.subjects_of(session, [job]).get(job_id, "")
        inputs = [_link(session, one) for one in job.inputs if one.kind != "artifact"]
        parent = None if job.parent_id is None else jobs.get_job(session, job.parent_id)
        turn = loops.get_loop(session, job_id) if job.kind == "loop" else None
        told = [events.figures_of(session, item.id) for item in family.values() if item.kind == "training"]
        links = {
            item.id: [_link(session, reference) for reference in item.outputs] for item in family.values()
        }

    def event_words(event: Event) -> str:
        about = "" if event.job_id == job_id else f"{family[event.job_id].kind}: "
        return about + describe(event)

    return {
        "job": job,
        "children": children,
        "parent": parent,
        "turn": turn,
        "subject": subject,
        "inputs": inputs,
        "links": links,
        "events": latest,
        "plots": [plot for points in told for plot in training_charts(points)],
        "event_words": event_words,
    }


def describe(event: Event) -> str:
    """One line for an entry of the log."""
    data = event.data
    if event.type == "progress":
        counted = progress_told(data.get("done", 0.0), data.get("total"), data.get("unit", ""))
        return " · ".join(part for part in (counted, data.get("message")) if part)
    if event.type == "state":
        error = data.get("error") or {}
        detail = error.get("detail") or error.get("title")
        return f"{data.get('state', '')}: {detail}" if detail else str(data.get("state", ""))
    return str(data.get("message", ""))


def _link(session: Session, reference: Reference) -> tuple[str, str]:
    """Path below the dashboard and label of what a job was made from or has made."""
    if reference.kind == "model":
        name, _, version = reference.id.rpartition(":")
        return f"/models/{name}/{version}", f"{name}, version {version}"
    if reference.kind == "fit":
        return f"/fits/{reference.id}", f"fit …{reference.id[-6:]}"
    if reference.kind == "scene":
        name = overview.scene_names(session, [reference.id]).get(reference.id, reference.id)
        return f"/scenes/{reference.id}", f"scene {name}"
    label = f"{reference.kind} …{reference.id[-6:]}"
    return f"/{reference.kind}s/{reference.id}", label
