"""``physworld traces …`` and ``physworld models assess``: what closes the loop, on a running service.

``physworld trace`` (without s) traces in one process and needs no service.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.lists import GROUPS, held_out_errors
from physworld_client.cli.names import found
from physworld_client.cli.options import Json, ModelName, SceneName, TraceName, VersionName, connected
from physworld_client.cli.output import millimetres, print_json, print_state, show, stdout
from physworld_client.client import Client
from physworld_client.resources import LATEST
from physworld_client.types import Assessment
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
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds to wait; default for ever.")] = None,
    json: Json = False,
) -> None:
    """Hold a new recording of the object against a published model."""
    scene_id = client.scenes.create(scene).id if Path(scene).exists() else found(client, "scenes", scene)
    job = client.assessments.create(name, scene_id, version, open_trace=trace)
    client.jobs.wait(job, timeout)
    answer = client.assessments.get(job.outputs[0].id)
    if json:
        print_json(answer)
    else:
        _print_assessment(answer)


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


def _print_assessment(found: Assessment) -> None:
    stdout.print(f"{found.outcome}: {found.reason}", markup=False, soft_wrap=True)
    baselines = ", ".join(f"{name} {millimetres(value)}" for name, value in found.baselines_m.items())
    stdout.print(f"also [mm]: twin {millimetres(found.twin_m)}, {baselines}", markup=False, soft_wrap=True)
    if found.trace_id is not None:
        stdout.print(f"trace opened: {found.trace_id}")
