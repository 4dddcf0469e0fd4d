"""Plots of answers with matplotlib, the extra ``plot`` of this distribution.

Each function returns the axes it drew on; the caller shows or saves the figure. Errors are in millimetres, logarithmic
where baselines dwarf the result, and a predictor has the colour that it has on the service's pages.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from physworld_client.errors import ExtraMissing, NothingToPlot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from physworld_schemas.job import Event

MM = 1e3
DWARFS = 10.0
"""From this ratio of the largest to the smallest on, an axis is logarithmic."""
PREDICTORS: dict[str, tuple[str, str, str]] = {
    "static": ("static", "#8a96a2", ":"),
    "rigid_follow": ("rigid follow", "#7c5cc4", "--"),
    "constant_velocity": ("constant velocity", "#b08900", "-."),
    "persistence": ("persistence", "#64748b", ":"),
    "twin_homogeneous": ("twin without its field", "#b4457a", "-"),
    "twin": ("twin", "#d9640f", "-"),
    "world_model": ("world model", "#8a5a2b", "-"),
    "world_model_finetuned": ("world model, fine-tuned", "#0d9488", "-"),
}
"""Label, colour and line of each predictor, as on the service's pages."""
BEFORE, AFTER, NOISE, QUIET = "#d9640f", "#3f7d20", "#5d6b78", "#8a96a2"


def held_out(metrics: Mapping[str, Any], title: str, axes: Axes | None = None) -> Axes:
    """Track errors on the held-out frames over time, with the noise floor."""
    table = metrics.get("held_out")
    curves = table.get("per_frame") if isinstance(table, Mapping) else None
    if not isinstance(table, Mapping) or not isinstance(curves, Mapping) or not curves.get("times_s"):
        raise NothingToPlot(title)
    drawn = _axes(axes)
    by_name = {name: values for name, values in curves["track_m"].items() if name in PREDICTORS}
    for name in (name for name in PREDICTORS if name in by_name):
        label, colour, line = PREDICTORS[name]
        drawn.plot(curves["times_s"], _mm(by_name[name]), line, color=colour, label=label)
    floor = table.get("noise_floor_m")
    if floor:
        drawn.axhline(MM * floor, color=NOISE, linestyle=":", label="noise floor")
    _scaled(drawn, [value for values in by_name.values() for value in values if value])
    return _named(drawn, title, "time [s]", "mean track error [mm]")


def compared(
    rows: Sequence[tuple[str, float, tuple[float, float] | None, str]], title: str, axes: Axes | None = None
) -> Axes:
    """Errors [m] with 95 % intervals, a row each: label, error, ends of the interval, colour."""
    if not rows:
        raise NothingToPlot(title)
    drawn = _axes(axes)
    for place, (_, value, ends, colour) in enumerate(rows):
        drawn.plot([MM * value], [place], "o", color=colour)
        if ends is not None:
            drawn.plot([MM * ends[0], MM * ends[1]], [place, place], "-", color=colour)
    drawn.set_yticks(range(len(rows)), [label for label, *_ in rows])
    drawn.invert_yaxis()
    values = [value for _, value, _, _ in rows if value > 0]
    if values and max(values) > DWARFS * min(values):
        drawn.set_xscale("log")
    return _named(drawn, title, "mean error [mm], 95 % interval", "")


def bars(
    values: Mapping[str, float], title: str, label: str, axes: Axes | None = None, line: float | None = None
) -> Axes:
    """Horizontal bars by name, with a threshold.

    Args:
        values: lengths by name, the first one on top.
        title: over the axes.
        label: of the lengths, with their unit.
        axes: to draw into; None makes a figure.
        line: place of the threshold, in the lengths' unit; None draws none.

    Raises:
        NothingToPlot: there is no value.
    """
    if not values:
        raise NothingToPlot(title)
    drawn = _axes(axes)
    drawn.barh(list(values), list(values.values()), color=QUIET)
    drawn.invert_yaxis()
    if line is not None:
        drawn.axvline(line, color=NOISE, linestyle=":", label="threshold")
    return _named(drawn, title, label, "")


def progress(events: Iterable[Event], title: str, axes: Axes | None = None) -> Axes:
    """The share of a job that was done over time, from its events."""
    told: list[tuple[datetime, float]] = []
    for event in events:
        share = event.data.get("fraction")
        if event.type == "progress" and isinstance(share, int | float):
            told.append((event.at, float(share)))
    if not told:
        raise NothingToPlot(title)
    drawn = _axes(axes)
    start = told[0][0]
    drawn.step(
        [(at - start).total_seconds() for at, _ in told], [100 * share for _, share in told], where="post"
    )
    drawn.set_ylim(0, 100)
    return _named(drawn, title, "time [s]", "done [%]")


def spans(moments: Sequence[tuple[str, datetime, datetime]], title: str, axes: Axes | None = None) -> Axes:
    """Stretches of time, a row each: what, from, to."""
    if not moments:
        raise NothingToPlot(title)
    drawn = _axes(axes)
    zero = moments[0][1]
    for place, (_, begin, end) in enumerate(moments):
        drawn.barh(place, (end - begin).total_seconds(), left=(begin - zero).total_seconds(), color=QUIET)
    drawn.set_yticks(range(len(moments)), [what for what, _, _ in moments])
    drawn.invert_yaxis()
    return _named(drawn, title, "time [s]", "")


def _axes(axes: Axes | None) -> Axes:
    if axes is not None:
        return axes
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ExtraMissing("plots", "plot") from error
    return plt.subplots(figsize=(8, 4), layout="constrained")[1]


def _named(axes: Axes, title: str, x_label: str, y_label: str) -> Axes:
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small")
    return axes


def _scaled(axes: Axes, values: Sequence[float]) -> None:
    if values and max(values) > DWARFS * min(values):
        axes.set_yscale("log")


def _mm(values: Sequence[float | None]) -> list[float]:
    return [float("nan") if value is None else MM * value for value in values]
