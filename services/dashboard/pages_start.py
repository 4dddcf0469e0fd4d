"""Forms that start a job, made of the wire models; a job's settings can be taken over and changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from physworld_schemas.base import TEXTS
from physworld_services.api.errors import ApiProblem
from physworld_services.dashboard.access import require_same_origin, require_writer
from physworld_services.dashboard.forms import faults_of, form_of, values_of
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.starts import STARTS, Start, body_of, choices_of, not_taken_over
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs import jobs

ObjectId = Annotated[str | None, Query(max_length=64, pattern=r"^[A-Za-z0-9_.:-]*$")]


def router(site: Site) -> APIRouter:
    """Pages below ``/start``."""
    routes = APIRouter(prefix="/start", dependencies=[Depends(require_writer)])

    @routes.get("/{kind}")
    def page(
        request: Request,
        kind: str,
        job: ObjectId = None,
        scene_id: ObjectId = None,
        fit_id: ObjectId = None,
        trace_id: ObjectId = None,
        dataset_id: ObjectId = None,
        model: ObjectId = None,
        version: ObjectId = None,
        name: ObjectId = None,
    ) -> HTMLResponse:
        values: dict[str, Any] = {}
        note = ""
        if job is not None:
            with site.database.reading() as session:
                before = jobs.get_job(session, job)
            values, note = body_of(before), not_taken_over(before)
        named = {"scene_id": scene_id, "fit_id": fit_id, "trace_id": trace_id, "dataset_id": dataset_id}
        named |= {"model": model, "version": version, "name": name}
        values |= {key: value for key, value in named.items() if value}
        return _page(site, request, kind, values, {}, 200, note)

    @routes.post("/{kind}", dependencies=[Depends(require_same_origin)])
    async def start(request: Request, kind: str) -> Response:
        form = await request.form(max_files=0, max_fields=200)
        sent = {key: [str(text) for text in form.getlist(key)] for key in form}
        return await run_in_threadpool(_start, site, request, kind, sent)

    return routes


def _start(site: Site, request: Request, kind: str, sent: Mapping[str, list[str]]) -> Response:
    known = _known(kind)
    values = values_of(known.body, sent)
    try:
        opening = known.open(site, known.body.model_validate(values, context=TEXTS))
        with site.database.session() as session:
            opened = opening(session)
    except ValidationError as error:
        return _page(site, request, kind, values, faults_of(error), 422)
    except ApiProblem as problem:
        places = {".".join(map(str, fault.loc[1:])): fault.msg for fault in problem.errors}
        return _page(site, request, kind, values, places or {"": str(problem.detail)}, problem.status_code)
    except (Conflict, NotFound) as error:
        told = f"There is {error}." if isinstance(error, NotFound) else f"{error}."
        return _page(site, request, kind, values, {"": told}, 409)
    return RedirectResponse(f"{BASE}/jobs/{opened.id}", 303)


def _page(
    site: Site,
    request: Request,
    kind: str,
    values: Mapping[str, Any],
    faults: Mapping[str, str],
    status: int,
    note: str = "",
) -> HTMLResponse:
    known = _known(kind)
    form = form_of(known.body, values, choices_of(site), faults)
    context = {"kind": kind, "start": known, "form": form, "told": faults.get("", ""), "starts": STARTS}
    context["note"] = note
    return site.page(request, "start.html", status=status, **context)


def _known(kind: str) -> Start:
    if kind not in STARTS:
        raise NotFound("kind of job", kind)
    return STARTS[kind]
