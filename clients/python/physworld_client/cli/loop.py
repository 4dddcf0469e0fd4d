"""``physworld traces …``, ``models assess`` and ``loops …``: what closes the loop, on a running service.

``physworld trace`` (without s) traces in one process and needs no service.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.lists import GROUPS, held_out_errors
from physworld_client.cli.names import found
from physworld_client.cli.options import (
    Json,
    LoopName,
    ModelName,
    SceneName,
    TraceName,
    VersionName,
    connected,
)
from physworld_client.cli.output import millimetres, print_json, print_state, show, stdout
from physworld_client.client import Client
from physworld_client.resources import LATEST
from physworld_client.types import Assessment, ErrorFigure, Loop
from physworld_schemas.fit import FitConfig
from physworld_schemas.trace import FoundEffect, TraceConfig


@connected(GROUPS["traces"], "add")
def traces_add(
    client: Client,
    scene_id: SceneName,
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
) -> None:
    """Start a trace of a scene."""
    config = TraceConfig(candidates=candidate or [])
    settings = None if particles is None else FitConfig(particle_budget=particles, damping="none")
    job = client.traces.create(
        scene_id,
        config,
        fit=settings,
        fit_id=None if fit is None else found(client, "fits", fit),
        scene_ids=[found(client, "scenes", one) for one in also or ()],
        held_out_scene_ids=[found(client, "scenes", one) for one in held_out or ()],
    )
    if json:
        print_json(job)
    else:
        stdout.print(f"{job.outputs[0].id} is {job.state}, job {job.id}")


@connected(GROUPS["traces"], "show")
def traces_show(client: Client, trace_id: TraceName, json: Json = False) -> None:
    """One trace: the verdict, the strengths, the errors before and after."""
    trace = client.traces.get(trace_id)
    if json or trace.verdict is None:
        show(trace, json)
        return
    stdout.print(f"{trace.verdict}: {trace.reason}", markup=False, soft_wrap=True)
    for title, effects in (("effect", trace.effects), ("or", trace.equivalent)):
        for effect in effects:
            stdout.print(f"{title:<11} {effect_text(effect)}", markup=False, soft_wrap=True)
    stdout.print(f"held-out error [mm]: {held_out_errors(trace)}", markup=False, soft_wrap=True)
    if trace.unexplained:
        stdout.print(f"remains: {trace.unexplained.get('description', '')}", markup=False, soft_wrap=True)
    if trace.suggested_experiment:
        stdout.print("an experiment that would tell more is suggested: see --json")
    stdout.print(f"{trace.simulations} simulations, {trace.seconds or 0.0:.0f} s")


@connected(GROUPS["traces"], "cancel")
def traces_cancel(client: Client, trace_id: TraceName, json: Json = False) -> None:
    """Cancel a trace that runs."""
    print_state(client.traces.cancel(trace_id), json)


@connected(GROUPS["models"], "assess")
def models_assess(
    client: Client,
    name: ModelName,
    scene: Annotated[str, typer.Argument(help="A recording's file or folder, or a scene of the service.")],
    version: VersionName = LATEST,
    trace: Annotated[bool, typer.Option(help="Open a trace where the model has become worse.")] = True,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Score the recording's held-out frames alone.")
    ] = False,
    beside: Annotated[
        int | None, typer.Option(min=1, help="Another version, measured on the same frames.")
    ] = None,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds to wait; default for ever.")] = None,
    json: Json = False,
) -> None:
    """Hold a new recording of the object against a published model."""
    scene_id = _recording(client, scene)
    job = client.assessments.create(
        name,
        scene_id,
        version,
        open_trace=trace,
        frames="held_out" if held_out else "all",
        compared_with=beside,
    )
    client.jobs.wait(job, timeout)
    answer = client.assessments.get(job.outputs[0].id)
    if json:
        print_json(answer)
    else:
        _print_assessment(answer)


@connected(GROUPS["loops"], "add")
def loops_add(
    client: Client,
    model: Annotated[str | None, typer.Argument(help="Name of a model, or the beginning of one.")] = None,
    scene: Annotated[
        str | None, typer.Argument(help="A recording's file or folder, or a scene of the service.")
    ] = None,
    version: VersionName = LATEST,
    assessment: Annotated[
        str | None, typer.Option(help="A ready assessment to go on from, instead of model and scene.")
    ] = None,
    candidate: Annotated[list[str] | None, typer.Option(help="Try this effect only; repeatable.")] = None,
    json: Json = False,
) -> None:
    """Trace a recording that a model predicts badly, and train the next version on what is found."""
    if assessment is None and (model is None or scene is None):
        raise typer.BadParameter("a MODEL and a SCENE are needed, or --assessment")
    if assessment is not None and model is not None:
        raise typer.BadParameter("--assessment says model and scene itself")
    job = client.loops.create(
        None if model is None else found(client, "models", model),
        None if scene is None else _recording(client, scene),
        version,
        assessment_id=assessment,
        trace=TraceConfig(candidates=candidate or []),
    )
    if json:
        print_json(job)
    else:
        stdout.print(f"{job.id} is {job.state}: see `physworld loops show {job.id}`")


@connected(GROUPS["loops"], "show")
def loops_show(client: Client, loop_id: LoopName, json: Json = False) -> None:
    """One loop: how it ended, and the errors of both versions on the recording's held-out frames."""
    loop = client.loops.get(loop_id)
    if json or loop.outcome is None:
        show(loop, json)
        return
    stdout.print(f"{loop.outcome}: {loop.reason}", markup=False, soft_wrap=True)
    for effect in loop.effects:
        stdout.print(f"effect      {effect_text(effect)}", markup=False, soft_wrap=True)
    _print_errors(loop)


@connected(GROUPS["loops"], "cancel")
def loops_cancel(client: Client, loop_id: LoopName, json: Json = False) -> None:
    """Cancel a loop that runs; what it has made stays."""
    print_state(client.jobs.cancel(loop_id), json)


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


def _recording(client: Client, scene: str) -> str:
    """The id of a scene of the service, or of a recording that is uploaded now."""
    return client.scenes.create(scene).id if Path(scene).exists() else found(client, "scenes", scene)


def _print_errors(loop: Loop) -> None:
    for one in (loop.before, loop.after):
        if one is not None:
            twin = f", its twin {millimetres(one.twin_m)}"
            text = f"version {one.version:<3} {_figure(one.measured)}{twin}"
            stdout.print(text, markup=False, soft_wrap=True)
    if loop.baselines_m:
        others = ", ".join(f"{name} {millimetres(value)}" for name, value in loop.baselines_m.items())
        stdout.print(f"also [mm]: {others}", markup=False, soft_wrap=True)


def _figure(error: ErrorFigure) -> str:
    """``1.66 mm (95 %: 1.41 to 2.07)``."""
    low, high = (millimetres(end) for end in error.ci95_m)
    return f"{millimetres(error.error_m)} mm (95 %: {low} to {high})"


def _print_assessment(found: Assessment) -> None:
    stdout.print(f"{found.outcome}: {found.reason}", markup=False, soft_wrap=True)
    baselines = ", ".join(f"{name} {millimetres(value)}" for name, value in found.baselines_m.items())
    stdout.print(f"also [mm]: twin {millimetres(found.twin_m)}, {baselines}", markup=False, soft_wrap=True)
    other = found.compared
    if other is not None:
        low, high = (millimetres(end) for end in other.gain_ci95_m)
        text = f"version {other.version} {_figure(other.measured)}, gain {millimetres(other.gain_m)}"
        stdout.print(f"{text} (95 %: {low} to {high})", markup=False, soft_wrap=True)
    if found.trace_id is not None:
        stdout.print(f"trace opened: {found.trace_id}")
