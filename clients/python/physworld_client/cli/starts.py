"""``physworld fits add``, ``datasets add``, ``models train``: one table of what is started with settings of its own.

Every plain setting of the wire model is an option of the command; ``--config FILE`` takes them all as JSON, and an
option counts before it. What is not given takes the service's default.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from physworld_client.cli.lists import GROUPS
from physworld_client.cli.names import found, one_of
from physworld_client.cli.options import Json, connected
from physworld_client.cli.output import print_json, progress_text, stdout
from physworld_client.client import Client
from physworld_client.errors import PhysWorldError
from physworld_client.types import Job
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.video import VideoConfig, VideoCreate

PLAIN = (int, float, str, bool)


@dataclass(frozen=True)
class Start:
    """A command that starts a job.

    Attributes:
        group: of commands.
        name: of the command.
        help: its line of help.
        config: the model of its settings.
        arguments: what it works on: (parameter, resource that it names one of; empty: a text of its own).
        create: of the client, the arguments in their order and the settings, to the job.
        chosen: options that name an object: (option, resource, help).
        repeated: repeatable options that name one each: (parameter, option, resource, help).
    """

    group: str
    name: str
    help: str
    config: type[BaseModel]
    arguments: tuple[tuple[str, str], ...]
    create: Callable[..., Job]
    chosen: tuple[tuple[str, str, str], ...] = field(default=())
    repeated: tuple[tuple[str, str, str, str], ...] = field(default=())


def _fit(client: Client, given: dict[str, Any], config: FitConfig) -> Job:
    return client.fits.create(given["scene_id"], config, scene_ids=given["scene_ids"])


def _dataset(client: Client, given: dict[str, str], config: DatasetConfig) -> Job:
    return client.datasets.create(given["fit_id"], config, trace_id=given.get("trace"))


def _training(client: Client, given: dict[str, str], config: TrainingConfig) -> Job:
    return client.models.create(given["name"], given["dataset_id"], config)


def _video(client: Client, given: dict[str, str], config: VideoConfig) -> Job:
    asked = VideoCreate.model_validate({"of": given["of"], "id": given["id"]})
    name, colon, version = asked.id.partition(":")
    return client.videos.create(asked.of, f"{found(client, f'{asked.of}s', name)}{colon}{version}", config)


TRACE = ("trace", "traces", "A ready trace, whose effects the demonstrations carry.")
STARTS = (
    Start(
        "fits",
        "add",
        "Calibrate a twin of a scene, or of several recordings of one object.",
        FitConfig,
        (("scene_id", "scenes"),),
        _fit,
        repeated=(
            ("scene_ids", "--with", "scenes", "Another recording of the object, fitted with it; repeatable."),
        ),
    ),
    Start(
        "datasets",
        "add",
        "Make demonstrations in a ready fit.",
        DatasetConfig,
        (("fit_id", "fits"),),
        _dataset,
        (TRACE,),
    ),
    Start(
        "models",
        "train",
        "Train a world model on a dataset and publish it as the next version of a name.",
        TrainingConfig,
        (("name", ""), ("dataset_id", "datasets")),
        _training,
    ),
    Start(
        "videos",
        "add",
        "Draw a film: OF is scene, fit, model or rollout, ID which of them (of a model NAME or NAME:VERSION).",
        VideoConfig,
        (("of", ""), ("id", "")),
        _video,
    ),
)


def _add(start: Start) -> None:
    settings = {
        name: (Annotated[kind | None, typer.Option(help=_help(info))], None)
        for name, info in start.config.model_fields.items()
        if (kind := plain_type(info.annotation)) is not None
    }
    options: dict[str, tuple[Any, Any]] = {
        name: (one_of(resource) if resource else str, inspect.Parameter.empty)
        for name, resource in start.arguments
    }
    for name, resource, text in start.chosen:
        options[name] = (Annotated[str | None, typer.Option(help=text), *_marks(resource)], None)
    for name, option, _, text in start.repeated:
        options[name] = (Annotated[list[str] | None, typer.Option(option, help=text)], None)
    options |= settings
    options["config"] = (
        Annotated[Path | None, typer.Option(help="Settings as JSON; options count before it.")],
        None,
    )
    options["wait"] = (Annotated[bool, typer.Option("--wait", help="Wait for the job's end.")], False)
    options["json"] = (Json, False)

    def started(client: Client, **given: Any) -> None:
        chosen = {name: given[name] for name in settings if given[name] is not None}
        config = start.config.model_validate({**_read(given["config"]), **chosen})
        named = [name for name, _ in start.arguments] + [name for name, _, _ in start.chosen]
        several = {
            name: [found(client, resource, one) for one in given[name] or ()]
            for name, _, resource, _ in start.repeated
        }
        job = start.create(client, {**{name: given[name] for name in named}, **several}, config)
        if not given["json"]:
            made = f"{job.outputs[0].id} is {job.state}, " if job.outputs else ""
            stdout.print(f"{made}job {job.id}", markup=False)
        if given["wait"]:
            job = client.jobs.wait(job, on_progress=None if given["json"] else _tell)
        if given["json"]:
            print_json(job)

    started.__doc__ = start.help
    connected(GROUPS[start.group], start.name, options)(started)


def plain_type(annotation: Any) -> Any:
    """The type of an option for a field: int, float, bool or str (names and choices too); None for other values."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (Union, UnionType):
        parts = [part for part in get_args(annotation) if part is not NoneType]
        kinds = {plain_type(part) for part in parts}
        return kinds.pop() if len(kinds) == 1 else None
    if get_origin(annotation) is Literal:
        return str if all(isinstance(choice, str) for choice in get_args(annotation)) else None
    return annotation if annotation in PLAIN else None


def _help(info: FieldInfo) -> str:
    """The field's description with its unit and its default."""
    more = info.json_schema_extra
    unit = f" [{more['unit']}]" if isinstance(more, dict) and more.get("unit") not in (None, "1") else ""
    default = "" if info.default is None or info.is_required() else f" Default {info.default}."
    return f"{info.description or ''}{unit}{default}"


def _marks(resource: str) -> tuple[Any, ...]:
    return tuple(one_of(resource).__metadata__[1:])


def _read(path: Path | None) -> dict[str, Any]:
    """Settings in a JSON file. Raises PhysWorldError where it holds none."""
    if path is None:
        return {}
    try:
        held = json.loads(path.read_text())
    except OSError as error:
        raise PhysWorldError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise PhysWorldError(f"{path} is no JSON: {error}") from error
    if not isinstance(held, dict):
        raise PhysWorldError(
            f"{path} holds no settings by name, but a {'list' if isinstance(held, list) else 'value'}"
        )
    return held


def _tell(job: Job) -> None:
    stdout.print(f"{job.state}  {progress_text(job)}", markup=False, soft_wrap=True)


for start in STARTS:
    _add(start)
