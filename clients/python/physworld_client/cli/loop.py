"""``physworld traces …`` and ``physworld models assess``: what closes the loop, on a running service.

``physworld trace`` (without s) traces in one process and needs no service.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from physworld_client.cli import service
from physworld_client.cli.lists import (
    DEFAULT_LIMIT,
    PAGE,
    Out,
    VersionName,
    download,
    models,
    show,
    show_list,
)
from physworld_client.cli.options import Data, Json, Limit, Token, Url
from physworld_client.cli.output import ago, print_json, stdout
from physworld_client.resources import LATEST
from physworld_schemas.assessment import Assessment
from physworld_schemas.fit import FitConfig
from physworld_schemas.trace import FoundEffect, Trace, TraceConfig

traces = typer.Typer(help="Residuals traced to effects.", no_args_is_help=True)


@traces.command("add")
def traces_add(
    scene_id: Annotated[str, typer.Argument(help="A scene of the service.")],
    fit: Annotated[str | None, typer.Option(help="A ready fit whose twin to begin with.")] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    candidate: Annotated[list[str] | None, typer.Option(help="Try this effect only; repeatable.")] = None,
    also: Annotated[
        list[str] | None,
        typer.Option("--with", help="Another recording of the object, fitted with it; repeatable."),
    ] = None,
    held_out: Annotated[
        list[str] | None, typer.Option(help="A recording that only the report sees; repeatable.")
    ] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Start a trace of a scene."""
    config = TraceConfig(candidates=candidate or [])
    settings = None if particles is None else FitConfig(particle_budget=particles, damping="none")
    with service.connect(url, token, data) as client:
        job = client.traces.create(
            scene_id,
            config,
            fit=settings,
            fit_id=fit,
            scene_ids=also or (),
            held_out_scene_ids=held_out or (),
        )
    if json:
        print_json(job)
    else:
        stdout.print(f"{job.outputs[0].id} is {job.state}, job {job.id}")


@traces.command("list")
def traces_list(
    limit: Limit = DEFAULT_LIMIT,
    scene: Annotated[str | None, typer.Option(help="Only traces of this scene.")] = None,
    verdict: Annotated[str | None, typer.Option(help="Only traces with this verdict.")] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Traces, newest first."""
    headings = ("id", "scene", "state", "verdict", "effects", "before → after [mm]", "age")

    def row(trace: Trace) -> tuple[str, ...]:
        effects = ", ".join(effect.name for effect in trace.effects)
        place = trace.scene or trace.scene_id
        return (
            trace.id,
            place,
            trace.state,
            trace.verdict or "",
            effects,
            _errors(trace),
            ago(trace.created_at),
        )

    with service.connect(url, token, data) as client:
        pages = client.traces.list(limit=min(limit, PAGE), scene_id=scene, verdict=verdict)
        show_list(pages.auto_paging_iter(), limit, json, headings, row)


@traces.command("show")
def traces_show(
    trace_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """One trace: the verdict, the strengths, the errors before and after."""
    with service.connect(url, token, data) as client:
        trace = client.traces.get(trace_id)
    if json or trace.verdict is None:
        show(trace, json)
        return
    stdout.print(f"{trace.verdict}: {trace.reason}", markup=False, soft_wrap=True)
    for title, effects in (("effect", trace.effects), ("or", trace.equivalent)):
        for effect in effects:
            stdout.print(f"{title:<11} {effect_text(effect)}", markup=False, soft_wrap=True)
    stdout.print(f"held-out error [mm]: {_errors(trace)}", markup=False, soft_wrap=True)
    if trace.unexplained:
        stdout.print(f"remains: {trace.unexplained.get('description', '')}", markup=False, soft_wrap=True)
    if trace.suggested_experiment:
        stdout.print("an experiment that would tell more is suggested: see --json")
    stdout.print(f"{trace.simulations} simulations, {trace.seconds or 0.0:.0f} s")


@traces.command("download")
def traces_download(
    trace_id: str,
    out: Out = None,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Download the files of a trace: the report, the tracks before and after, the twin with the effects."""
    with service.connect(url, token, data) as client:
        download(client, client.traces.get(trace_id).artifacts, out or Path(trace_id))


@traces.command("cancel")
def traces_cancel(
    trace_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Cancel a trace that runs."""
    with service.connect(url, token, data) as client:
        job = client.traces.cancel(trace_id)
    if json:
        print_json(job)
    else:
        stdout.print(f"{job.id} is {job.state}")


@models.command("assess")
def models_assess(
    name: str,
    scene: Annotated[str, typer.Argument(help="A recording's file or folder, or the id of a scene.")],
    version: VersionName = LATEST,
    trace: Annotated[bool, typer.Option(help="Open a trace where the model has become worse.")] = True,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds to wait; default for ever.")] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Hold a new recording of the object against a published model."""
    with service.connect(url, token, data) as client:
        scene_id = client.scenes.create(scene).id if Path(scene).exists() else scene
        job = client.assessments.create(name, scene_id, version, open_trace=trace)
        client.jobs.wait(job, timeout)
        found = client.assessments.get(job.outputs[0].id)
    if json:
        print_json(found)
    else:
        _print_assessment(found)


def effect_text(effect: FoundEffect) -> str:
    """``air_drag_linear: rate_per_s 1.9 1/s (95 %: 1.6 to 2.2)``."""
    parts = []
    for name, number in effect.parameters.items():
        value = "?" if number.value is None else f"{number.value:.4g}"
        text = f"{name} {value} {number.unit}".rstrip()
        if number.ci95 is not None and None not in number.ci95:
            text += f" (95 %: {number.ci95[0]:.4g} to {number.ci95[1]:.4g})"
        parts.append(text)
    return f"{effect.name}: {', '.join(parts)}"


def millimetres(metres: Any) -> str:
    """A length in mm with three digits, ``?`` where there is none."""
    return f"{1e3 * metres:.3g}" if isinstance(metres, int | float) and np.isfinite(metres) else "?"


def _errors(trace: Trace) -> str:
    held_out = trace.held_out
    if held_out is None:
        return ""
    text = f"{millimetres(held_out.get('before'))} → {millimetres(held_out.get('after'))}"
    floor = held_out.get("noise_floor")
    return text if floor is None else f"{text} (noise {millimetres(floor)})"


def _print_assessment(found: Assessment) -> None:
    stdout.print(f"{found.outcome}: {found.reason}", markup=False, soft_wrap=True)
    baselines = ", ".join(f"{name} {millimetres(value)}" for name, value in found.baselines_m.items())
    stdout.print(f"also [mm]: twin {millimetres(found.twin_m)}, {baselines}", markup=False, soft_wrap=True)
    if found.trace_id is not None:
        stdout.print(f"trace opened: {found.trace_id}")
