"""What the command line lists, shows and downloads: one table of resources, and the commands that are made of it.

Every command goes through the SDK; ``--json`` prints the wire models as they are. What else can be done with a
resource stands in ``actions``, ``starts``, ``registry`` and ``loop``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from physworld_client.cli.names import one_of
from physworld_client.cli.options import Json, Limit, Out, connected
from physworld_client.cli.output import (
    ago,
    millimetres,
    print_json,
    print_table,
    progress_text,
    show,
    stdout,
)
from physworld_client.client import Client
from physworld_client.manifest import checked_name
from physworld_client.pages import ListPage
from physworld_client.types import (
    ApiKey,
    Assessment,
    Check,
    Dataset,
    Episode,
    Fit,
    Job,
    Loop,
    Model,
    ModelVersion,
    Plan,
    Rollout,
    Scene,
    Trace,
    Video,
)
from physworld_schemas.base import Artifact

DEFAULT_LIMIT = 20
PAGE = 100

Row = Callable[[Any], Sequence[object]]


@dataclass(frozen=True)
class Listing:
    """One list of a resource.

    Attributes:
        name: of the command, and the method of the client's resource.
        help: its line of help.
        headings: of the columns.
        row: the cells of an item.
        of: the argument that names whose list it is, and of which resource that is; None: all of the service.
        filters: options that narrow it: (option, the method's keyword, help).
    """

    name: str
    help: str
    headings: tuple[str, ...]
    row: Row
    of: tuple[str, str] | None = None
    filters: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True)
class Resource:
    """One resource of the service as the command line knows it.

    Attributes:
        name: of the group of commands, and the client's attribute.
        help: the group's line of help.
        lists: its lists.
        one: what ``show`` and ``download`` call one of them; their argument is its id.
        shown: whether ``show`` prints it field by field; otherwise it has a command of its own.
        files: what ``download`` fetches; None: it has a command of its own, or no files.
    """

    name: str
    help: str
    lists: tuple[Listing, ...]
    one: str
    shown: bool = True
    files: str | None = None

    @property
    def argument(self) -> Any:
        """The type of the argument that names one: by its id alone where there is no list of all of them."""
        return one_of(self.name) if self.lists[0].of is None else str


def _scene(scene: Scene) -> Sequence[object]:
    counts = (scene.frames, scene.points, scene.controllers)
    return (scene.id, scene.name, scene.kind, *counts, ", ".join(scene.tags), ago(scene.created_at))


def _fit(fit: Fit) -> Sequence[object]:
    parameters = (f"{name} {value.value:.4g} {value.unit}" for name, value in fit.parameters.items())
    return (fit.id, fit.scene_id, fit.standing, ", ".join(parameters), ago(fit.created_at))


def _check(check: Check) -> Sequence[object]:
    visible = counted = ""
    if check.report is not None:
        effects = check.report.views[-1].effects
        visible = str(sum(effect.status == "visible" for effect in effects))
        counted = str(len(effects))
    return (check.id, check.scene_id, check.state, visible, counted, ago(check.created_at))


def _trace(trace: Trace) -> Sequence[object]:
    effects = ", ".join(effect.name for effect in trace.effects)
    verdict = (trace.verdict or "", effects, held_out_errors(trace))
    return (trace.id, trace.scene or trace.scene_id, trace.state, *verdict, ago(trace.created_at))


def _dataset(dataset: Dataset) -> Sequence[object]:
    episodes = f"{dataset.episodes_done}/{dataset.config.episodes}"
    return (dataset.id, dataset.fit_id, dataset.state, episodes, ago(dataset.created_at))


def _episode(episode: Episode) -> Sequence[object]:
    made = (episode.index, episode.motion, episode.seed, episode.frames)
    return (*made, episode.particles, episode.attempt, episode.digest[:12])


def _model(model: Model) -> Sequence[object]:
    aliases = ", ".join(f"{alias} → {number}" for alias, number in sorted(model.aliases.items()))
    return (
        model.name,
        model.latest_version or "none",
        model.latest or "none",
        aliases,
        ago(model.created_at),
    )


def _version(version: ModelVersion) -> Sequence[object]:
    digest = (version.sha256 or "")[:12]
    marks = (version.version, version.state, version.quality.verdict, ", ".join(version.aliases))
    return (*marks, digest, ago(version.created_at))


def _rollout(run: Rollout) -> Sequence[object]:
    age = "" if run.created_at is None else ago(run.created_at)
    return (run.id, f"{run.model}:{run.version}", run.state, run.candidates, run.ticks, age)


def _plan(run: Plan) -> Sequence[object]:
    errors = (millimetres(run.executed_error_m), millimetres(run.motionless_error_m))
    return (run.id, f"{run.model}:{run.version}", run.state, *errors, ago(run.created_at))


def _film(film: Video) -> Sequence[object]:
    scores = film.report.scores if film.report else None
    frames = "" if film.report is None else film.report.frames
    ratio = "" if scores is None or scores.psnr_db is None else f"{scores.psnr_db:.1f}"
    similar = "" if scores is None else f"{scores.ssim:.3f}"
    return (film.id, film.of, film.source_id, film.state, frames, ratio, similar, ago(film.created_at))


def _assessment(one: Assessment) -> Sequence[object]:
    return (
        one.id,
        f"{one.name}:{one.version}",
        one.scene_id,
        one.state,
        one.outcome or "",
        ago(one.created_at),
    )


def _loop(one: Loop) -> Sequence[object]:
    versions = f"{one.version} → {one.new_version}" if one.new_version else str(one.version)
    effects = ", ".join(effect.name for effect in one.effects)
    end = (one.outcome or one.state, effects, loop_errors(one))
    return (one.id, one.model, versions, *end, ago(one.created_at))


def _key(key: ApiKey) -> Sequence[object]:
    return (key.id, key.name, key.role, ending(key), ago(key.created_at))


def ending(key: ApiKey) -> str:
    """When a key ends: a day, ``revoked``, or ``never``."""
    if key.revoked_at is not None:
        return "revoked"
    return "never" if key.expires_at is None else f"{key.expires_at:%Y-%m-%d}"


def _job(job: Job) -> Sequence[object]:
    return (job.id, job.kind, job.state, progress_text(job), ago(job.created_at))


def loop_errors(one: Loop) -> str:
    """``18.3 → 1.66`` [mm], version before and after; empty before they are measured."""
    if one.before is None or one.after is None:
        return ""
    return f"{millimetres(one.before.measured.error_m)} → {millimetres(one.after.measured.error_m)}"


def held_out_errors(trace: Trace) -> str:
    """``2.31 → 1.7 (noise 1.6)`` [mm]; nothing before the trace has measured them."""
    held_out = trace.held_out
    if held_out is None:
        return ""
    text = f"{millimetres(held_out.get('before'))} → {millimetres(held_out.get('after'))}"
    floor = held_out.get("noise_floor")
    return text if floor is None else f"{text} (noise {millimetres(floor)})"


SCENES = Listing(
    "list",
    "Scenes, newest first.",
    ("id", "name", "kind", "frames", "points", "controllers", "tags", "age"),
    _scene,
    filters=(
        ("kind", "kind", "Only objects of this kind."),
        ("tag", "tag", "Only scenes that have this tag."),
    ),
)
FITS = Listing("list", "Fits, newest first.", ("id", "scene", "state", "parameters", "age"), _fit)
CHECKS = Listing(
    "list",
    "Checks, newest first.",
    ("id", "scene", "state", "visible", "effects", "age"),
    _check,
    filters=(("scene", "scene_id", "Only checks of this scene."),),
)
TRACES = Listing(
    "list",
    "Traces, newest first.",
    ("id", "scene", "state", "verdict", "effects", "before → after [mm]", "age"),
    _trace,
    filters=(
        ("scene", "scene_id", "Only traces of this scene."),
        ("verdict", "verdict", "Only traces with this verdict."),
    ),
)
DATASETS = Listing("list", "Datasets, newest first.", ("id", "fit", "state", "episodes", "age"), _dataset)
EPISODES = Listing(
    "episodes",
    "The committed episodes of a dataset.",
    ("index", "motion", "seed", "frames", "particles", "attempt", "digest"),
    _episode,
    of=("dataset_id", "datasets"),
)
MODELS = Listing("list", "Registered names.", ("name", "newest", "latest", "aliases", "age"), _model)
VERSIONS = Listing(
    "versions",
    "Versions of a name, newest first.",
    ("version", "state", "quality", "aliases", "sha256", "age"),
    _version,
    of=("name", "models"),
)
JOBS = Listing(
    "list",
    "Jobs, newest first.",
    ("id", "kind", "state", "progress", "age"),
    _job,
    filters=(
        ("state", "state", "Only jobs in this state."),
        ("kind", "kind", "Only jobs of this kind."),
    ),
)
ROLLOUTS = Listing(
    "list",
    "Rollouts that were jobs, newest first.",
    ("id", "model", "state", "candidates", "ticks", "age"),
    _rollout,
    filters=(("model", "model", "Only rollouts of this model."),),
)
PLANS = Listing(
    "list",
    "Plans, newest first.",
    ("id", "model", "state", "in the twin [mm]", "without motion [mm]", "age"),
    _plan,
    filters=(("model", "model", "Only plans with this model."),),
)
VIDEOS = Listing(
    "list",
    "Films, newest first.",
    ("id", "of", "what", "state", "frames", "PSNR [dB]", "SSIM", "age"),
    _film,
    filters=(
        ("scene", "scene_id", "Only films that belong to this scene."),
        ("of", "of", "Only films of this kind: scene, fit, model or rollout."),
        ("source", "source_id", "Only films of this object."),
    ),
)
ASSESSMENTS = Listing(
    "list",
    "Recordings held against models.",
    ("id", "model", "scene", "state", "outcome", "age"),
    _assessment,
    filters=(("model", "name", "Only assessments of this model."),),
)
LOOPS = Listing(
    "list",
    "Turns of the loop, newest first.",
    ("id", "model", "versions", "outcome", "effects", "before → after [mm]", "age"),
    _loop,
    filters=(
        ("model", "model", "Only loops of this model."),
        ("state", "state", "Only loops in this state."),
    ),
)
KEYS = Listing("list", "Keys, newest first, ended ones too.", ("id", "name", "role", "until", "age"), _key)
RESOURCES = (
    Resource("scenes", "Measured scenes.", (SCENES,), "scene", files="the files of a scene"),
    Resource(
        "fits", "Calibrated twins.", (FITS,), "fit", files="the files of a fit: the twin and its report"
    ),
    Resource("checks", "What recordings can show before any fit.", (CHECKS,), "check"),
    Resource(
        "traces",
        "Residuals traced to effects.",
        (TRACES,),
        "trace",
        shown=False,
        files="the files of a trace: the report, the tracks before and after, the twin with the effects",
    ),
    Resource("datasets", "Datasets of demonstration episodes.", (DATASETS, EPISODES), "dataset"),
    Resource("models", "Published world models.", (MODELS, VERSIONS), "model", shown=False),
    Resource("jobs", "Jobs.", (JOBS,), "job"),
    Resource(
        "rollouts", "Predictions that were jobs.", (ROLLOUTS,), "rollout", files="the arrays of a rollout"
    ),
    Resource("plans", "Motions that reach a goal.", (PLANS,), "plan", files="the arrays of a plan"),
    Resource(
        "videos",
        "Films of motions, drawn by the service.",
        (VIDEOS,),
        "video",
        files="the film, and the recording beside it",
    ),
    Resource("assessments", "New recordings held against models.", (ASSESSMENTS,), "assessment"),
    Resource("loops", "From a badly predicted recording to the next version.", (LOOPS,), "loop", shown=False),
    Resource("keys", "API keys of the service.", (KEYS,), "key", shown=False),
)


def group_of(resource: Resource) -> typer.Typer:
    """The group of a resource's commands, with those that the table tells of."""
    group = typer.Typer(help=resource.help, no_args_is_help=True)
    for listing in resource.lists:
        _add_list(group, resource, listing)
    if resource.shown:
        _add_show(group, resource)
    if resource.files is not None:
        _add_download(group, resource)
    return group


def _add_list(group: typer.Typer, resource: Resource, listing: Listing) -> None:
    options: dict[str, tuple[Any, Any]] = {}
    if listing.of is not None:
        options[listing.of[0]] = (one_of(listing.of[1]), inspect.Parameter.empty)
    options["limit"] = (Limit, DEFAULT_LIMIT)
    for option, _, text in listing.filters:
        options[option] = (Annotated[str | None, typer.Option(help=text)], None)
    options["json"] = (Json, False)

    def listed(client: Client, **given: Any) -> None:
        method: Callable[..., ListPage[Any]] = getattr(getattr(client, resource.name), listing.name)
        whose = () if listing.of is None else (given[listing.of[0]],)
        chosen = {keyword: given[option] for option, keyword, _ in listing.filters}
        pages = method(*whose, limit=min(given["limit"], PAGE), **chosen).auto_paging_iter()
        show_list(pages, given["limit"], given["json"], listing.headings, listing.row)

    listed.__doc__ = listing.help
    connected(group, listing.name, options)(listed)


def _add_show(group: typer.Typer, resource: Resource) -> None:
    name = f"{resource.one}_id"

    def shown(client: Client, **given: Any) -> None:
        show(getattr(client, resource.name).get(given[name]), given["json"])

    shown.__doc__ = f"One {resource.one}."
    connected(group, "show", {name: (resource.argument, inspect.Parameter.empty), "json": (Json, False)})(
        shown
    )


def _add_download(group: typer.Typer, resource: Resource) -> None:
    name = f"{resource.one}_id"

    def downloaded(client: Client, **given: Any) -> None:
        found = getattr(client, resource.name).get(given[name])
        download(client, found.artifacts, given["out"] or Path(given[name]))

    downloaded.__doc__ = f"Download {resource.files}."
    which = (resource.argument, inspect.Parameter.empty)
    connected(group, "download", {name: which, "out": (Out, None)})(downloaded)


def show_list(
    items: Iterable[BaseModel], limit: int, as_json: bool, headings: tuple[str, ...], row: Row
) -> None:
    """Prints the first items of a list.

    Args:
        items: as they come from the service.
        limit: at most so many.
        as_json: the wire models instead of a table.
        headings: of the columns.
        row: the cells of an item.
    """
    chosen = list(islice(items, limit))
    if as_json:
        print_json(chosen)
    else:
        print_table(headings, (tuple(map(str, row(item))) for item in chosen))


def download(client: Client, artifacts: list[Artifact], folder: Path) -> None:
    """Every file into a folder, named as it comes."""
    for artifact in artifacts:
        path = client.artifacts.download(artifact, folder / checked_name(artifact.name))
        stdout.print(f"{path.absolute()}  {artifact.size} bytes", soft_wrap=True)
    if not artifacts:
        stdout.print("no files yet")


GROUPS = {resource.name: group_of(resource) for resource in RESOURCES}
"""The groups of commands, by their names; the other modules add what is no list."""
