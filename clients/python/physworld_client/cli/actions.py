"""What the command line does with scenes, datasets, jobs and keys beside listing them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydantic import ValidationError
from rich.progress import Progress

from physworld_client.cli.fit import become
from physworld_client.cli.lists import GROUPS, PAGE, download, ending
from physworld_client.cli.options import DatasetName, JobName, Json, KeyName, Out, SceneName, connected
from physworld_client.cli.output import (
    print_json,
    print_state,
    print_table,
    progress_text,
    show,
    stderr,
    stdout,
)
from physworld_client.client import Client
from physworld_client.export import FORMATS
from physworld_client.types import Job
from physworld_schemas.key import DEFAULT_GRACE_MINUTES, DEFAULT_LIFETIME_DAYS, MAX_GRACE_MINUTES, KeyCreate
from physworld_schemas.library import catalogue
from physworld_schemas.scene import SceneImport

FORMS = "; ".join(f"{name}: {form.title}" for name, form in FORMATS.items()) + "."
RECORDING = f"A folder with scene.json, or a file: {', '.join(one.title for one in catalogue().importers)}."


def _known(format: str) -> str:
    if format not in FORMATS:
        raise typer.BadParameter(f"{format!r} is none of {', '.join(FORMATS)}")
    return format


@connected(GROUPS["scenes"], "add")
def scenes_add(
    client: Client,
    path: Annotated[Path, typer.Argument(help=RECORDING)],
    options: Annotated[
        str | None, typer.Option(help="What the recording does not say: a SceneImport, as JSON.")
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Say what would be guessed, store nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Upload a scene."""
    try:
        given = None if options is None else SceneImport.model_validate_json(options)
    except ValidationError as error:
        raise typer.BadParameter(
            f"--options: {error.errors()[0]['loc']}: {error.errors()[0]['msg']}"
        ) from error
    if not preview:
        show(client.scenes.create(path, given), json)
        return
    found = client.scenes.preview(path, given)
    if json:
        print_json(found)
        return
    print_table(
        ("what", "value", "how", "option"), [(g.what, g.value, g.how, g.option) for g in found.guesses]
    )
    for line in found.lines:
        stdout.print(line, markup=False, soft_wrap=True)


@connected(GROUPS["scenes"], "describe")
def scenes_describe(
    client: Client,
    scene_id: SceneName,
    tag: Annotated[
        list[str] | None, typer.Option(help="Tags from now on; repeatable; none: no tags.")
    ] = None,
    json: Json = False,
) -> None:
    """Give a scene other tags; the recording never changes."""
    show(client.scenes.update(scene_id, tags=tuple(tag or ())), json)


@connected(GROUPS["scenes"], "picture")
def scenes_picture(
    client: Client,
    scene_id: SceneName,
    path: Annotated[Path, typer.Argument(help="Splat (.ply), camera (.json) or pictures (.npz).")],
    json: Json = False,
) -> None:
    """Keep a splat, a camera or pictures beside a scene, for its films."""
    scene = client.videos.put_picture(scene_id, path)
    if json:
        print_json(scene)
    else:
        for artifact in scene.artifacts:
            stdout.print(f"{artifact.name}  {artifact.size} bytes", markup=False)


@connected(GROUPS["datasets"], "download")
def datasets_download(
    client: Client,
    dataset_id: DatasetName,
    out: Out = None,
    episodes: Annotated[bool, typer.Option("--episodes", help="Every episode too, as npz.")] = False,
) -> None:
    """Download the manifest of a dataset, and its episodes when asked."""
    folder = out or Path(dataset_id)
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


@connected(GROUPS["datasets"], "export")
def datasets_export(
    client: Client,
    dataset_id: DatasetName,
    format: Annotated[
        str,
        typer.Option("--format", "-f", metavar="|".join(FORMATS), callback=_known, help=FORMS),
    ] = "npz",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="New or empty folder [./ID-FORMAT].")
    ] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Only the first so many.")] = None,
    points: Annotated[
        int | None, typer.Option(min=1, help="At most so many particles a frame [ply: all, lerobot: 256].")
    ] = None,
) -> None:
    """Write the episodes of a sealed dataset as npz, PLY or LeRobot v3."""
    folder = out or Path(f"{dataset_id}-{format}")
    with Progress(console=stderr, transient=True) as shown:
        task = shown.add_task("episodes", total=None)

        def tell(done: int, total: int) -> None:
            shown.update(task, completed=done, total=total)

        client.datasets.export(
            dataset_id, folder, format=format, episodes=episodes, points=points, on_progress=tell
        )
    stdout.print(f"{folder.absolute()}", soft_wrap=True)


@GROUPS["scenes"].command("check")
def scenes_check(
    paths: Annotated[list[Path], typer.Argument(metavar="SCENE...", help=RECORDING)],
    json: Json = False,
) -> None:
    """Name every fault and warning of a scene in this process; needs no service. Exit code 2 where one is refused."""
    become("physworld_workers.commands.scene_check", [*(["--json"] if json else []), "--", *map(str, paths)])


@connected(GROUPS["keys"], "create")
def keys_create(
    client: Client,
    name: Annotated[str, typer.Argument(help="Who or what uses the key.")],
    role: Annotated[str, typer.Option(help="read, write, or admin, which may manage keys too.")] = "read",
    days: Annotated[int, typer.Option(min=0, help="Until it ends; 0: never.")] = DEFAULT_LIFETIME_DAYS,
    json: Json = False,
) -> None:
    """Make a key; its token is printed once and kept nowhere."""
    asked = KeyCreate.model_validate({"name": name, "role": role})
    made = client.keys.create(name, asked.role, expires_in_days=days or None)
    if json:
        print_json(made)
    else:
        stdout.print(f"{made.id}  {made.name}, {made.role}, until {ending(made)}", markup=False)
        print(made.token)


@connected(GROUPS["keys"], "rotate")
def keys_rotate(
    client: Client,
    key_id: KeyName,
    grace: Annotated[
        int,
        typer.Option(
            "--grace", min=0, max=MAX_GRACE_MINUTES, help="Minutes that the old token stays good; 0: none."
        ),
    ] = DEFAULT_GRACE_MINUTES,
    json: Json = False,
) -> None:
    """Give a key another token and its whole term again; the token is printed once and kept nowhere."""
    made = client.keys.rotate(key_id, grace_minutes=grace)
    if json:
        print_json(made)
        return
    old = f"{made.old_token_until:%Y-%m-%d %H:%M} UTC" if grace and made.old_token_until else "at once"
    text = f"{made.id}  {made.name}, {made.role}, until {ending(made)}; its old token ends {old}"
    stdout.print(text, markup=False, soft_wrap=True)
    print(made.token)


@connected(GROUPS["keys"], "revoke")
def keys_revoke(client: Client, key_id: KeyName) -> None:
    """End a key, and what it opened, at once."""
    ended = client.keys.revoke(key_id)
    stdout.print(f"{ended.id}  {ended.name} is revoked", markup=False)


@connected(GROUPS["jobs"], "wait")
def jobs_wait(
    client: Client,
    job_id: JobName,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds; default for ever.")] = None,
    json: Json = False,
) -> None:
    """Wait for a job's end; exit code 1 when it failed or was cancelled."""

    def tell(job: Job) -> None:
        if not json:
            stdout.print(f"{job.state}  {progress_text(job)}", soft_wrap=True)

    job = client.jobs.wait(job_id, timeout, tell)
    if json:
        print_json(job)


@connected(GROUPS["jobs"], "retry")
def jobs_retry(client: Client, job_id: JobName, json: Json = False) -> None:
    """Take a failed job up again; what it stored is kept."""
    print_state(client.jobs.retry(job_id), json)


@connected(GROUPS["jobs"], "cancel")
def jobs_cancel(client: Client, job_id: JobName, json: Json = False) -> None:
    """Cancel a job and everything it started."""
    print_state(client.jobs.cancel(job_id), json)
