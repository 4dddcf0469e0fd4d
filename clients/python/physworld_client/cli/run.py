"""``physworld run SCENE``: the main job from a recording to a downloaded world model, followed to its end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli import service
from physworld_client.cli.follow import follow
from physworld_client.cli.names import found
from physworld_client.cli.options import JSON_FILE, Data, Token, Url
from physworld_client.cli.output import stderr, stdout
from physworld_client.cli.report import CLOSED_LOOP, STAGES, build_report, print_report, write_report
from physworld_client.cli.up import require_service_code
from physworld_client.client import Client
from physworld_client.errors import JobFailed, PhysWorldError
from physworld_client.transport import DEFAULT_MAX_RETRIES
from physworld_client.types import Job, Scene
from physworld_client.waiting import require_success
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import TERMINAL_STATES
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate, RunReport

CANCEL_WAIT_S = 30.0


def run(
    scene: Annotated[
        str,
        typer.Argument(
            help="Folder, archive, final_data.pkl or table of markers, or a scene of the service."
        ),
    ],
    episodes: Annotated[int | None, typer.Option(min=1, help="Demonstration episodes.")] = None,
    hidden: Annotated[int | None, typer.Option(min=8, help="Width of the graph network.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps.")] = None,
    vertices: Annotated[int | None, typer.Option(min=4, help="Vertices of the graph.")] = None,
    start_from: Annotated[
        str | None, typer.Option(help="Version NAME:VERSION whose network the training goes on from.")
    ] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    simulations: Annotated[int | None, typer.Option(min=1, help="Most simulations of the fit.")] = None,
    law: Annotated[str | None, typer.Option(help="Elastic law by name, or auto: choose it.")] = None,
    plasticity: Annotated[
        str | None, typer.Option(help="Flow law by name; its yield is calibrated too.")
    ] = None,
    formulation: Annotated[
        str | None, typer.Option(help="total_lagrangian, updated_lagrangian, discrete_rod or auto.")
    ] = None,
    transfer: Annotated[
        str | None, typer.Option(help="Of the updated Lagrangian form: apic or asflip.")
    ] = None,
    mesh: Annotated[
        str | None, typer.Option(help="Of a sheet: the mesh of triangles that recorded it, such as 16x15.")
    ] = None,
    stages: Annotated[
        str | None, typer.Option(help="Of the fit: global, or global+local with a field over the body.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of demonstration and training.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model [the scene's name].")] = None,
    close_the_loop: Annotated[
        bool,
        typer.Option("--close-the-loop", help="Trace what the twin leaves, and add a named effect to it."),
    ] = False,
    compare: Annotated[
        bool, typer.Option(help="Train a model without the effect too, so that the card can compare.")
    ] = True,
    json: Annotated[
        Path | None, typer.Option(callback=JSON_FILE, help="Write the figures to this file.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the model [DATA/models/NAME-VERSION].")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Workers, if the service must be started.")] = 2,
    keep_up: Annotated[bool, typer.Option("--keep-up", help="Leave a started service running.")] = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Fit, demonstrate, train, publish, download: from a recording to a world model."""
    settings: dict[str, object] = {
        "episodes": episodes,
        "hidden": hidden,
        "steps": steps,
        "vertices": vertices,
        "start_from": start_from,
    }
    settings |= {"seed": seed, "particle_budget": particles, "max_simulations": simulations}
    settings |= {
        "law": law,
        "plasticity": plasticity,
        "formulation": formulation,
        "transfer": transfer,
        "mesh": mesh,
        "stages": stages,
    }
    if not Path(scene).expanduser().exists() and service.find(url, token, data) is None:
        raise PhysWorldError(
            f"no scene at {scene}: neither a folder nor a file, and no service runs that may know it"
        )
    with _service(url, token, data, workers, keep_up) as (address, alive):
        with address.client(DEFAULT_MAX_RETRIES) as client:
            loop = {"close_the_loop": True, "compare": compare} if close_the_loop else {}
            report, folder = _run(client, scene, name, settings, loop, out, address, alive)
    print_report(report)
    if json is not None:
        write_report(report, json)
        stdout.print(f"report: {json.absolute()}", soft_wrap=True)
    stdout.print(f"model files (verified): {folder.absolute()}", soft_wrap=True)
    if address.data is not None:
        stdout.print(f"data: {address.data}", soft_wrap=True)
    if alive():
        stdout.print(f"dashboard: {address.dashboard_url}", soft_wrap=True)
    elif address.data is not None:
        stdout.print(f"dashboard: physworld up --data {address.data}", soft_wrap=True)


@contextmanager
def _service(
    url: str | None, token: str | None, data: Path | None, workers: int, keep_up: bool
) -> Iterator[tuple[service.Address, Callable[[], bool]]]:
    """A running service, or one started for this run and stopped at its end; and whether it (still) runs."""
    running = service.find(url, token, data)
    if running is not None:
        stdout.print(f"service: {running.url} (running), dashboard {running.dashboard_url}", soft_wrap=True)
        yield running, lambda: True
        return
    require_service_code()
    folder = service.data_folder(data)
    stdout.print(f"starting the service on {folder} …", soft_wrap=True)
    embedded = service.Embedded(folder, workers, stays=keep_up)
    try:
        address = embedded.wait_until_ready()
        stdout.print(f"service: {address.url}, dashboard {address.dashboard_url}", soft_wrap=True)
        yield address, embedded.alive
    except JobFailed:
        stderr.print(f"logs of the service: {embedded.log.parent}", soft_wrap=True)
        raise
    finally:
        if not keep_up:
            embedded.stop()


def _run(
    client: Client,
    scene: str,
    name: str | None,
    settings: dict[str, object],
    loop: dict[str, bool],
    out: Path | None,
    address: service.Address,
    alive: Callable[[], bool],
) -> tuple[RunReport, Path]:
    """The main job on a running service: its report, and the folder with the verified model."""
    uploaded = _scene(client, scene)
    stdout.print(
        f"scene: {uploaded.name} ({uploaded.id}), {uploaded.frames} frames at {uploaded.fps:g} Hz, "
        f"{uploaded.points} points, {uploaded.controllers} controllers, held out: frames "
        f"{uploaded.test[0]} to {uploaded.test[1] - 1}",
        soft_wrap=True,
    )
    for warning in uploaded.warnings:
        stdout.print(f"warning: {warning}", markup=False, soft_wrap=True)
    pipeline = client.pipelines.create(_pipeline(uploaded.id, name, settings, loop))
    stdout.print(f"job: {pipeline.id}")
    try:
        pipeline, stages = follow(client, pipeline.id, alive, CLOSED_LOOP if loop else STAGES)
    except KeyboardInterrupt:
        _cancel(client, pipeline.id)
        raise
    _require_success(pipeline, stages)
    outputs = {reference.kind: reference.id for job in stages.values() for reference in job.outputs}
    missing = [kind for kind in ("fit", "dataset", "model") if kind not in outputs]
    if missing:
        raise PhysWorldError(f"job {pipeline.id} succeeded without a {' and a '.join(missing)}")
    model_name, _, number = outputs["model"].rpartition(":")
    folder = out or (address.data / "models" if address.data else Path()) / f"{model_name}-{number}"
    version = client.models.download(model_name, folder, int(number), trust=address.signing_key)
    dataset = client.datasets.get(outputs["dataset"])
    fit = client.fits.get(outputs["fit"])
    return build_report(uploaded.name, pipeline, stages, fit, version, dataset.episodes_done), folder


def _scene(client: Client, given: str) -> Scene:
    """The scene at a path, uploaded; else the one of the service that is called so.

    Raises:
        PhysWorldError: there is nothing at the path, and no scene has such an id or name.
    """
    if Path(given).expanduser().exists():
        return client.scenes.create(given)
    try:
        return client.scenes.get(found(client, "scenes", given))
    except PhysWorldError as error:
        raise PhysWorldError(f"no scene at {given}: neither a folder nor a file, and {error}") from error


def _pipeline(
    scene_id: str, name: str | None, settings: dict[str, object], loop: dict[str, bool]
) -> PipelineCreate:
    """The body of the request: only what was given; the service fills in its defaults."""
    given = {key: value for key, value in settings.items() if value is not None}
    body: dict[str, object] = {"scene_id": scene_id, **loop}
    if name is not None:
        body["model_name"] = name
    for key, config in (("fit", FitConfig), ("dataset", DatasetConfig), ("training", TrainingConfig)):
        chosen = {field: value for field, value in given.items() if field in config.model_fields}
        if chosen:
            body[key] = chosen
    return PipelineCreate.model_validate(body)


def _require_success(pipeline: Job, stages: dict[str, Job]) -> None:
    """Raises the error of the stage that failed, with its numbers; else the pipeline's own."""
    for job in stages.values():
        if job.state == "failed":
            raise JobFailed(job)
    require_success(pipeline)


def _cancel(client: Client, job_id: str) -> None:
    """Cancels the job after Ctrl-C and says what became of it."""
    stderr.print(f"cancelling {job_id} …")
    try:
        job = client.jobs.cancel(job_id)
        end = time.monotonic() + CANCEL_WAIT_S
        while job.state not in TERMINAL_STATES and time.monotonic() < end:
            job = client.jobs.get(job_id, wait_s=2.0)
    except PhysWorldError as error:
        stderr.print(f"{job_id} could not be cancelled: {error}", markup=False, soft_wrap=True)
        return
    stderr.print(f"{job_id} is {job.state}")
