"""``physworld scenes|fits|datasets|models|jobs``: look at what the service holds, cancel, download.

Every command goes through the SDK; ``--json`` prints the wire models as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import typer
from pydantic import BaseModel

from physworld_client.cli import service
from physworld_client.cli.export import export
from physworld_client.cli.options import Data, Json, Limit, Token, Url
from physworld_client.cli.output import ago, print_fields, print_json, print_table, stdout
from physworld_client.client import Client
from physworld_client.manifest import checked_name
from physworld_client.resources import LATEST
from physworld_schemas.base import Artifact
from physworld_schemas.dataset import Dataset
from physworld_schemas.fit import Fit
from physworld_schemas.job import Job
from physworld_schemas.model import Model, ModelVersion
from physworld_schemas.scene import Scene

Item = TypeVar("Item", bound=BaseModel)
DEFAULT_LIMIT = 20
PAGE = 100

scenes = typer.Typer(help="Measured scenes.", no_args_is_help=True)
fits = typer.Typer(help="Calibrated twins.", no_args_is_help=True)
datasets = typer.Typer(help="Datasets of demonstration episodes.", no_args_is_help=True)
datasets.command("export")(export)
models = typer.Typer(help="Published world models.", no_args_is_help=True)
jobs = typer.Typer(help="Jobs.", no_args_is_help=True)

Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the files [./ID].")]
VersionName = Annotated[str, typer.Option("--version", help="A number, an alias, or latest.")]


@scenes.command("list")
def scenes_list(
    limit: Limit = DEFAULT_LIMIT, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Scenes, newest first."""
    headings = ("id", "name", "kind", "frames", "points", "controllers", "age")

    def row(scene: Scene) -> tuple[str, ...]:
        counts = (str(scene.frames), str(scene.points), str(scene.controllers))
        return (scene.id, scene.name, scene.kind, *counts, ago(scene.created_at))

    with service.connect(url, token, data) as client:
        show_list(client.scenes.list(limit=min(limit, PAGE)).auto_paging_iter(), limit, json, headings, row)


@scenes.command("add")
def scenes_add(
    path: Annotated[Path, typer.Argument(help="Folder, archive, final_data.pkl or C3D file.")],
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Upload a scene."""
    with service.connect(url, token, data) as client:
        show(client.scenes.create(path), json)


@scenes.command("show")
def scenesshow(
    scene_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """One scene."""
    with service.connect(url, token, data) as client:
        show(client.scenes.get(scene_id), json)


@scenes.command("download")
def scenes_download(
    scene_id: str, out: Out = None, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Download the files of a scene."""
    with service.connect(url, token, data) as client:
        download(client, client.scenes.get(scene_id).artifacts, out or Path(scene_id))


@fits.command("list")
def fits_list(
    limit: Limit = DEFAULT_LIMIT, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Fits, newest first."""
    headings = ("id", "scene", "state", "parameters", "age")

    def row(fit: Fit) -> tuple[str, ...]:
        shown = ", ".join(f"{name} {value.value:.4g} {value.unit}" for name, value in fit.parameters.items())
        return (fit.id, fit.scene_id, fit.state, shown, ago(fit.created_at))

    with service.connect(url, token, data) as client:
        show_list(client.fits.list(limit=min(limit, PAGE)).auto_paging_iter(), limit, json, headings, row)


@fits.command("show")
def fitsshow(
    fit_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """One fit."""
    with service.connect(url, token, data) as client:
        show(client.fits.get(fit_id), json)


@fits.command("download")
def fits_download(
    fit_id: str, out: Out = None, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Download the files of a fit: the twin and its report."""
    with service.connect(url, token, data) as client:
        download(client, client.fits.get(fit_id).artifacts, out or Path(fit_id))


@datasets.command("list")
def datasets_list(
    limit: Limit = DEFAULT_LIMIT, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Datasets, newest first."""
    headings = ("id", "fit", "state", "episodes", "age")

    def row(dataset: Dataset) -> tuple[str, ...]:
        episodes = f"{dataset.episodes_done}/{dataset.config.episodes}"
        return (dataset.id, dataset.fit_id, dataset.state, episodes, ago(dataset.created_at))

    with service.connect(url, token, data) as client:
        show_list(client.datasets.list(limit=min(limit, PAGE)).auto_paging_iter(), limit, json, headings, row)


@datasets.command("show")
def datasetsshow(
    dataset_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """One dataset."""
    with service.connect(url, token, data) as client:
        show(client.datasets.get(dataset_id), json)


@datasets.command("episodes")
def datasets_episodes(
    dataset_id: str,
    limit: Limit = DEFAULT_LIMIT,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """The committed episodes of a dataset."""
    headings = ("index", "motion", "seed", "frames", "particles", "attempt", "digest")
    with service.connect(url, token, data) as client:
        show_list(
            client.datasets.episodes(dataset_id, limit=min(limit, PAGE)).auto_paging_iter(),
            limit,
            json,
            headings,
            lambda episode: (
                *(str(number) for number in (episode.index, episode.motion, episode.seed, episode.frames)),
                *(str(number) for number in (episode.particles, episode.attempt)),
                episode.digest[:12],
            ),
        )


@datasets.command("download")
def datasets_download(
    dataset_id: str,
    out: Out = None,
    episodes: Annotated[bool, typer.Option("--episodes", help="Every episode too, as npz.")] = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Download the manifest of a dataset, and its episodes when asked."""
    folder = out or Path(dataset_id)
    with service.connect(url, token, data) as client:
        download(client, client.datasets.get(dataset_id).artifacts, folder)
        if not episodes:
            return
        folder.mkdir(parents=True, exist_ok=True)
        count = 0
        for episode in client.datasets.episodes(dataset_id, limit=PAGE).auto_paging_iter():
            arrays = client.datasets.episode(dataset_id, episode.index)
            np.savez(folder / f"episode-{episode.index:05d}.npz", allow_pickle=False, **arrays)
            count += 1
    stdout.print(f"{folder.absolute()}  {count} episodes", soft_wrap=True)


@models.command("list")
def models_list(
    limit: Limit = DEFAULT_LIMIT, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Registered names."""

    def row(model: Model) -> tuple[str, ...]:
        aliases = ", ".join(f"{alias} → {number}" for alias, number in sorted(model.aliases.items()))
        return (model.name, str(model.latest_version or "none"), aliases, ago(model.created_at))

    with service.connect(url, token, data) as client:
        pages = client.models.list(limit=min(limit, PAGE)).auto_paging_iter()
        show_list(pages, limit, json, ("name", "latest", "aliases", "age"), row)


@models.command("versions")
def models_versions(
    name: str,
    limit: Limit = DEFAULT_LIMIT,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Versions of a name, newest first."""

    def row(version: ModelVersion) -> tuple[str, ...]:
        digest = (version.sha256 or "")[:12]
        return (
            str(version.version),
            version.state,
            ", ".join(version.aliases),
            digest,
            ago(version.created_at),
        )

    with service.connect(url, token, data) as client:
        pages = client.models.versions(name, limit=min(limit, PAGE)).auto_paging_iter()
        show_list(pages, limit, json, ("version", "state", "aliases", "sha256", "age"), row)


@models.command("show")
def modelsshow(
    name: str,
    version: VersionName = LATEST,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """One version of a model."""
    with service.connect(url, token, data) as client:
        show(client.models.version(name, version), json)


@models.command("alias")
def models_alias(
    name: str, alias: str, version: int, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Point an alias at a version."""
    with service.connect(url, token, data) as client:
        client.models.set_alias(name, alias, version)
    stdout.print(f"{name}@{alias} is version {version}")


@jobs.command("list")
def jobs_list(
    limit: Limit = DEFAULT_LIMIT,
    state: Annotated[str | None, typer.Option(help="Only jobs in this state.")] = None,
    kind: Annotated[str | None, typer.Option(help="Only jobs of this kind.")] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Jobs, newest first."""

    def row(job: Job) -> tuple[str, ...]:
        return (job.id, job.kind, job.state, progress_text(job), ago(job.created_at))

    with service.connect(url, token, data) as client:
        pages = client.jobs.list(limit=min(limit, PAGE), state=state, kind=kind).auto_paging_iter()
        show_list(pages, limit, json, ("id", "kind", "state", "progress", "age"), row)


@jobs.command("show")
def jobsshow(
    job_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """One job."""
    with service.connect(url, token, data) as client:
        show(client.jobs.get(job_id), json)


@jobs.command("wait")
def jobs_wait(
    job_id: str,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds; default for ever.")] = None,
    json: Json = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Wait for a job's end; exit code 1 when it failed or was cancelled."""

    def tell(job: Job) -> None:
        if not json:
            stdout.print(f"{job.state}  {progress_text(job)}", soft_wrap=True)

    with service.connect(url, token, data) as client:
        job = client.jobs.wait(job_id, timeout, tell)
    if json:
        print_json(job)


@jobs.command("retry")
def jobs_retry(
    job_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Take a failed job up again; what it stored is kept."""
    with service.connect(url, token, data) as client:
        _print_state(client.jobs.retry(job_id), json)


@jobs.command("cancel")
def jobs_cancel(
    job_id: str, json: Json = False, url: Url = None, token: Token = None, data: Data = None
) -> None:
    """Cancel a job and everything it started."""
    with service.connect(url, token, data) as client:
        _print_state(client.jobs.cancel(job_id), json)


def _print_state(job: Job, json: bool) -> None:
    if json:
        print_json(job)
    else:
        stdout.print(f"{job.id} is {job.state}")


def progress_text(job: Job) -> str:
    """``12 of 40 episodes, message``."""
    progress = job.progress
    parts = []
    if progress.total:
        parts.append(f"{progress.done:g} of {progress.total:g} {progress.unit}".strip())
    if progress.message:
        parts.append(progress.message)
    return ", ".join(parts)


def show_list(
    items: Iterable[Item],
    limit: int,
    json: bool,
    headings: tuple[str, ...],
    row: Callable[[Item], tuple[str, ...]],
) -> None:
    """The first ``limit`` items as a table, or as JSON."""
    chosen = list(islice(items, limit))
    if json:
        print_json(chosen)
    else:
        print_table(headings, map(row, chosen))


def show(value: BaseModel, json: bool) -> None:
    """One object, field by field, or as JSON."""
    if json:
        print_json(value)
    else:
        print_fields(value)


def download(client: Client, artifacts: list[Artifact], folder: Path) -> None:
    """Every file into a folder, named as it comes."""
    for artifact in artifacts:
        path = client.artifacts.download(artifact, folder / checked_name(artifact.name))
        stdout.print(f"{path.absolute()}  {artifact.size} bytes", soft_wrap=True)
    if not artifacts:
        stdout.print("no files yet")
