"""``physworld rollout MODEL`` and ``physworld plan MODEL``: use a published model of a running service."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from physworld_client.arrays import arrays_of
from physworld_client.cli.names import found as known_as
from physworld_client.cli.names import help_of
from physworld_client.cli.options import NPZ_FILE, Json
from physworld_client.cli.output import print_json, stderr, stdout
from physworld_client.client import Client
from physworld_client.errors import PhysWorldError
from physworld_client.resources import LATEST
from physworld_client.types import Array, Plan
from physworld_schemas.plan import PlanConfig, PlanLimits
from physworld_schemas.rollout import Part
from physworld_schemas.wording import reason

MOST_GRIPS = 100
Version = Annotated[str, typer.Option(help="Number, alias or latest.")]


def rollout(
    client: Client,
    model: Annotated[str, typer.Argument(help=help_of("models"))],
    controllers: Annotated[
        Path,
        typer.Option(help="npz with controllers, (B, T, K, 3) or (T, K, 3) [m], and perhaps times (T,) [s]."),
    ],
    out: Annotated[
        Path,
        typer.Option(callback=NPZ_FILE, help="Write times, points and what else is asked for to this npz."),
    ],
    version: Version = LATEST,
    rest: Annotated[bool, typer.Option(help="Begin at rest, not as the recording did.")] = False,
    vertices: Annotated[bool, typer.Option(help="Also the vertices of the graph.")] = False,
    every: Annotated[int, typer.Option(min=1, help="Return each so many-th tick.")] = 1,
    stiffness: Annotated[float, typer.Option(help="Factor on the stiffness.")] = 1.0,
    opened: Annotated[
        list[str] | None,
        typer.Option(
            "--open", metavar="GRIP:BEGIN,END", help="A grip, from 0, is open from BEGIN to END [s]."
        ),
    ] = None,
    twin: Annotated[
        bool | None,
        typer.Option(
            "--twin/--network",
            help="By the calibrated twin that the version learned from, or by its network; default as its card says.",
        ),
    ] = None,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds to wait for a job.")] = None,
    json: Json = False,
) -> None:
    """Predict what the object does under given motions of its control points."""
    arrays = _controllers(controllers)
    returns: list[Part] = ["points", "vertices"] if vertices else ["points"]
    model = known_as(client, "models", model)
    found = client.rollouts.create(
        model,
        arrays["controllers"],
        _version(version),
        times=arrays.get("times"),
        start="rest" if rest else "recording",
        stiffness_factor=stiffness,
        returns=returns,
        every=every,
        open_s=open_times(opened or []),
        by=None if twin is None else "twin" if twin else "model",
        timeout=timeout,
    )
    parts = {"points": found.points, "vertices": found.vertices}
    _write(out, {"times": found.times, **{name: part for name, part in parts.items() if part is not None}})
    if json:
        print_json(found.rollout.model_copy(update={"points": None, "vertices": None}))
        return
    answer = found.rollout
    by = "twin" if answer.by == "twin" else "network"
    stdout.print(
        f"{model} version {answer.version}, by its {by}: {answer.candidates} x {answer.ticks} ticks of "
        f"{answer.dt_s:.4g} s in {answer.seconds or 0.0:.2f} s, controls up to {answer.speed_m_s:.3g} m/s, "
        f"written to {out}",
        markup=False,
        soft_wrap=True,
    )


def open_times(spans: list[str]) -> list[list[tuple[float, float]]] | None:
    """Times at which each grip is open [s] from texts GRIP:BEGIN,END. Raises BadParameter."""
    found: dict[int, list[tuple[float, float]]] = {}
    for text in spans:
        try:
            grip, _, times = text.partition(":")
            begin, end = (float(part) for part in times.split(","))
            number = int(grip)
        except ValueError as error:
            raise typer.BadParameter(f"{text!r} is not GRIP:BEGIN,END", param_hint="--open") from error
        if not 0 <= number < MOST_GRIPS:
            raise typer.BadParameter(
                f"{text!r} is of grip {number}; they are 0 to {MOST_GRIPS - 1}", param_hint="--open"
            )
        found.setdefault(number, []).append((begin, end))
    return [found.get(grip, []) for grip in range(max(found) + 1)] if found else None


def plan(
    client: Client,
    model: Annotated[str, typer.Argument(help=help_of("models"))],
    goal: Annotated[
        Path,
        typer.Option(help="npz: index (M,) and places (M, 3) [m] of measured points, or shape (M, 3) [m]."),
    ],
    out: Annotated[
        Path,
        typer.Option(callback=NPZ_FILE, help="Write the control path and the predicted paths to this npz."),
    ],
    version: Version = LATEST,
    horizon: Annotated[int, typer.Option(min=2, help="Ticks of the motion.")] = 60,
    samples: Annotated[int, typer.Option(min=8, help="Motions tried in an iteration.")] = 512,
    iterations: Annotated[int, typer.Option(min=1, help="Of the search.")] = 10,
    speed: Annotated[
        float | None, typer.Option(min=0, help="Fastest grip [m/s]; default the recording's.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds to wait; default for ever.")] = None,
    json: Json = False,
) -> None:
    """Find a motion of the grips that brings the object to a goal, and check it in the twin."""
    points, shape = _goal(goal)
    config = PlanConfig(horizon=horizon, samples=samples, iterations=iterations, seed=seed)
    model = known_as(client, "models", model)
    job = client.plans.create(
        model,
        _version(version),
        points=points,
        shape=shape,
        limits=PlanLimits(speed_m_s=speed),
        config=config,
    )
    stderr.print(f"job {job.id}", markup=False)
    client.jobs.wait(job, timeout)
    found = client.plans.result(job.outputs[0].id)
    _write(out, found.arrays)
    if json:
        print_json(found.plan)
    else:
        _print_plan(found.plan, out)


def _print_plan(plan: Plan, out: Path) -> None:
    def mm(metres: float | None) -> str:
        return "?" if metres is None else f"{1e3 * metres:.3g}"

    stdout.print(
        f"{plan.id}: {plan.samples} motions tried, written to {out}\n"
        f"error to the goal [mm]: predicted {mm(plan.predicted_error_m)}, executed in the twin "
        f"{mm(plan.executed_error_m)}, without motion {mm(plan.motionless_error_m)}\n"
        f"model against twin on the way [mm]: {mm(plan.model_against_twin_m)}",
        markup=False,
        soft_wrap=True,
    )


def _controllers(path: Path) -> dict[str, Array]:
    """From an npz, or from the ``suggested_experiment`` of a trace's report (JSON)."""
    if path.suffix == ".json":
        try:
            report: dict[str, Any] = jsonlib.loads(path.read_text())
            experiment = report.get("suggested_experiment", report)
            if not experiment or not experiment.get("controllers"):
                raise PhysWorldError(f"{path} suggests no experiment with a motion")
            return {
                "controllers": np.array(experiment["controllers"], dtype=float),
                "times": np.array(experiment["times_s"], dtype=float),
            }
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PhysWorldError(f"{path} is no report of a trace: {reason(error)}") from error
    arrays = _npz(path)
    if "controllers" not in arrays:
        raise PhysWorldError(f"{path} holds {sorted(arrays)}, no controllers")
    return arrays


def _goal(path: Path) -> tuple[dict[int, Sequence[float]] | None, Array | None]:
    """Places (x, y, z) [m] by the number of their point, or a shape (M, 3) [m]. Raises PhysWorldError."""
    arrays = _npz(path)
    if not {"index", "places"} <= arrays.keys():
        if "shape" not in arrays:
            raise PhysWorldError(f"{path} holds {sorted(arrays)}; a goal is index and places, or shape")
        return None, arrays["shape"]
    index, places = arrays["index"], arrays["places"]
    if index.ndim != 1 or index.dtype.kind not in "iu" or places.shape != (len(index), 3):
        raise PhysWorldError(
            f"{path} has index {index.shape} of {index.dtype} and places {places.shape}; a goal is whole numbers (M,) "
            "and (M, 3)"
        )
    points: dict[int, Sequence[float]] = {
        int(number): place for number, place in zip(index, places.tolist(), strict=True)
    }
    if len(points) < len(index):
        raise PhysWorldError(f"{path} names {len(index) - len(points)} of {len(index)} points twice")
    return points, None


def _npz(path: Path) -> dict[str, Array]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PhysWorldError(f"{path} cannot be read: {error.strerror}") from error
    return arrays_of(data, str(path))


def _write(path: Path, arrays: dict[str, Array]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _version(text: str) -> int | str:
    return int(text) if text.isdecimal() else text
