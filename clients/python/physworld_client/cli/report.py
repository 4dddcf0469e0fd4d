"""The report of one main job: gathered from its objects, printed as the results table, written as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from physworld_client.cli.output import stdout
from physworld_client.errors import PhysWorldError
from physworld_client.types import Fit, Job, ModelVersion
from physworld_schemas.library import Metric, catalogue
from physworld_schemas.pipeline import ModelReference, RunReport

MAIN_METRIC = "track_m"
ROWS = {
    "static": "static",
    "rigid_follow": "rigid-follow",
    "constant_velocity": "constant velocity",
    "persistence": "persistence",
    "twin": "twin",
    "world_model": "world model",
    "world_model_finetuned": "world model, fine-tuned",
}
OPTIONAL_ROWS = frozenset({"persistence"})
OF_THE_MODEL = frozenset({"world_model", "world_model_finetuned"})
"""Left out where other grips hold at times in the recording than in the version."""
SPEEDS = {"twin": "twin", "world_model": "world model"}
STAGES = ("fit", "dataset", "training")
CLOSED_LOOP = ("fit", "trace", "dataset", "training")


def build_report(
    scene_name: str, pipeline: Job, stages: Mapping[str, Job], fit: Fit, version: ModelVersion, episodes: int
) -> RunReport:
    """The figures of a succeeded pipeline.

    Args:
        stages: the pipeline's child jobs by stage; their times give ``seconds``.
        episodes: committed episodes of the dataset.

    Raises:
        PhysWorldError: the published model lacks a figure that every run must have.
    """
    metrics = version.metrics
    held_out = _table(metrics, "held_out", version)
    optional = OPTIONAL_ROWS | (frozenset() if metrics.get("judged_on_recording", True) else OF_THE_MODEL)
    metrics_held = [one.name for one in catalogue().listed_metrics() if one.name in held_out]
    for metric in dict.fromkeys([MAIN_METRIC, *metrics_held]):
        missing = [row for row in ROWS if row not in optional and row not in held_out.get(metric, {})]
        if missing:
            raise PhysWorldError(f"{_label(version)} has no held_out.{metric} of {', '.join(missing)}")
    speeds = _table(metrics, "steps_per_second", version)
    if version.sha256 is None:
        raise PhysWorldError(f"{_label(version)} is not published")
    seconds = {stage: duration_s(job) for stage, job in stages.items()}
    seconds["total"] = duration_s(pipeline)
    noise_floor = metrics.get("noise_floor_m", held_out.get("noise_floor_m"))
    return RunReport(
        scene=scene_name,
        held_out={metric: dict(held_out[metric]) for metric in metrics_held},
        noise_floor_m=noise_floor,
        steps_per_second={name: float(speeds[name]) for name in SPEEDS if name in speeds},
        model=ModelReference(name=version.name, version=version.version, sha256=version.sha256),
        seconds=seconds,
        episodes=episodes,
        parameters={name: value.model_dump(mode="json") for name, value in fit.parameters.items()},
        notes=[str(note) for note in metrics.get("notes", [])] + _failures(version),
        closed_loop=metrics.get("closed_loop"),
    )


def print_report(report: RunReport) -> None:
    """The results table, the speeds and the model."""
    table = Table(title=Text(f"Held-out error of {report.scene}"), title_justify="left")
    table.add_column("prediction")
    columns = [catalogue().metric(name) for name in report.held_out]
    for metric in columns:
        table.add_column(Text(f"{metric.title}{shown_unit(metric)}"), justify="right")
    first = report.held_out[MAIN_METRIC]
    for row, heading in ROWS.items():
        if row in first:
            cells = [_measured(metric, report.held_out[metric.name].get(row)) for metric in columns]
            table.add_row(heading, *cells, end_section=row == _last_baseline(first))
    stdout.print()
    stdout.print(table)
    if report.noise_floor_m is not None:
        stdout.print(f"noise floor of the track error: {_millimetres(report.noise_floor_m)} mm")
    speeds = [
        f"{name} {report.steps_per_second[key]:.4g}"
        for key, name in SPEEDS.items()
        if key in report.steps_per_second
    ]
    stdout.print(f"steps per second: {', '.join(speeds)}")
    for name, parameter in report.parameters.items():
        stdout.print(_parameter_line(name, parameter), markup=False, soft_wrap=True)
    if report.closed_loop is not None:
        _print_closed_loop(report.closed_loop)
    parts = [f"{stage} {seconds:.0f}" for stage, seconds in report.seconds.items()]
    stdout.print(f"seconds: {', '.join(parts)}; episodes: {report.episodes}")
    for note in report.notes:
        stdout.print(f"note: {note}", markup=False, soft_wrap=True)
    model = report.model
    stdout.print(f"model: {model.name} version {model.version}, sha256 {model.sha256}", soft_wrap=True)


def write_report(report: RunReport, path: Path) -> None:
    """Writes the report as JSON in one piece."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    part.write_text(report.model_dump_json(indent=2) + "\n")
    part.replace(path)


def duration_s(job: Job) -> float:
    """Seconds from a job's start to its end, or until now."""
    start = job.started_at or job.created_at
    end = job.finished_at or datetime.now(UTC)
    return max(0.0, (end - start).total_seconds())


def _print_closed_loop(section: Mapping[str, Any]) -> None:
    """The verdict in a sentence, and the errors before and after."""
    stdout.print(f"closed loop: {section['statement']}", markup=False, soft_wrap=True)
    for name, title in (("twin", "twin"), ("world_model", "world model")):
        figures = section.get(name)
        if figures is None:
            continue
        if figures["before_m"] is None:
            stdout.print(
                f"  {title}: after {_millimetres(figures['after_m'])} mm, nothing to compare it with"
            )
            continue
        gain = figures["gain_ci95_m"]
        interval = (
            "" if gain is None else f", gain {_millimetres(gain[0])} to {_millimetres(gain[1])} mm (95 %)"
        )
        before, after = f"{_millimetres(figures['before_m'])} mm before", _millimetres(figures["after_m"])
        if figures.get("recalibrated_m") is not None:
            before += f", {_millimetres(figures['recalibrated_m'])} mm calibrated anew without the effect"
        stdout.print(f"  {title}: held-out error {before}, {after} mm after{interval}", soft_wrap=True)


def _table(metrics: Mapping[str, Any], key: str, version: ModelVersion) -> Mapping[str, Any]:
    table = metrics.get(key)
    if not isinstance(table, dict):
        raise PhysWorldError(
            f"{_label(version)} carries no figures {key!r} (it has: {', '.join(metrics) or 'none'})"
        )
    return table


def _failures(version: ModelVersion) -> list[str]:
    """Why the version is not ``latest``, where it failed the quality gate."""
    return [f"{_label(version)} failed the quality gate: {reason}" for reason in version.quality.reasons]


def _label(version: ModelVersion) -> str:
    return f"model {version.name} version {version.version}"


def _last_baseline(rows: Mapping[str, object]) -> str:
    return "persistence" if "persistence" in rows else "constant_velocity"


def shown_unit(metric: Metric) -> str:
    """The unit that a column's values have, with a comma before it: lengths are shown in millimetres."""
    return "" if metric.unit == "1" else f", {'mm' if metric.unit == 'm' else metric.unit}"


def _measured(metric: Metric, value: float | None) -> str:
    if metric.unit == "m" or value is None:
        return _millimetres(value)
    return f"{value:.3g}"


def _millimetres(metres: float | None) -> str:
    if metres is None:
        return "n/a"
    return f"{1000.0 * metres:.2f}"


def _parameter_line(name: str, parameter: Mapping[str, Any]) -> str:
    unit = parameter["unit"] if parameter["unit"] != "1" else ""
    text = f"{name}: {parameter['value']:.4g} {unit}".rstrip()
    if parameter.get("ci95"):
        low, high = parameter["ci95"]
        text += f" (95 %: {low:.4g} to {high:.4g})"
    if not parameter.get("identified", True):
        text += f", not identified: {parameter.get('note') or 'held at its prior'}"
    return text
