"""The pictures of a trace's page, each from the report or the residuals alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.report.curves import Residuals, mean_component, per_frame
from physworld.report.markup import Html, scrolled, tag
from physworld.report.predictors import PREDICTORS
from physworld.report.svg import Axes, Series, legend_of, line_chart, picture
from physworld.report.words import title

MM = 1e3
MOST_FRAMES = 600
LEAST_SHARE = 0.005  # of the residual: candidates below it share a line


def horizon(found: Residuals, sigma: float | None) -> Html:
    """Error of the open-loop predictions against the horizon, with baselines and the noise floor."""
    picked = _picked(found)
    series = [
        Series(one.label, one.role, _mm(found.baselines[name][picked]), 1.4, one.dash)
        for name, one in PREDICTORS.items()
        if name in found.baselines
    ]
    if sigma:
        series.append(Series("noise floor", "noise", [MM * sigma] * len(picked), 1.6, "3 3"))
    series.append(
        Series("before" if not found.same else "twin", "before", _mm(per_frame(found.before)[picked]))
    )
    if not found.same:
        series.append(Series("after", "after", _mm(per_frame(found.after)[picked])))
    return line_chart(
        found.times[picked].tolist(), series, title="Error against horizon", x_label="time since frame 0 [s]",
        y_label="rms error [mm]", split=found.split_s, log_y=True, height=340, width=1080,
    )  # fmt: skip


def components(found: Residuals) -> Html:
    """Mean residual along x, y and z over time: a missing force shows as a direction."""
    picked = _picked(found)
    charts = []
    for axis, name in enumerate("xyz"):
        was = _mm(mean_component(found.before, axis)[picked])
        series = [Series("twin" if found.same else "before", "before", was, 1.8)]
        if not found.same:
            series.append(Series("after", "after", _mm(mean_component(found.after, axis)[picked]), 1.8))
        charts.append(
            line_chart(
                found.times[picked].tolist(), series, title=f"Mean residual along {name}", x_label="time [s]",
                y_label=f"along {name} [mm]", split=found.split_s, height=230, width=380, symmetric=True, named=False,
            )
        )  # fmt: skip
    return tag("div", tag("div", *charts, class_="three"), legend_of(series))


def candidates(report: dict[str, Any]) -> Html:
    """Scores of all candidates, and the posterior of those that were fitted."""
    rows = report.get("candidates", [])
    if not rows:
        return tag("p", "No candidate was scored.", class_="quiet")
    threshold = float(rows[0].get("threshold") or 0.0)
    posterior: dict[str, float] = {}
    for known in report.get("hypotheses", []):
        for name in known.get("effects", []):
            posterior[name] = posterior.get(name, 0.0) + float(known.get("posterior") or 0.0)
    also = {effect.get("name") for effect in report.get("equivalent", [])}
    head = ["candidate", "share of the residual it explains, to first order", "posterior"]
    shown = [row for row in rows if _telling(row, also)]
    quiet = [row for row in rows if not _telling(row, also)]
    body = [_candidate(row, threshold, also, posterior.get(row.get("name", ""))) for row in shown]
    cells = [tag("th", h, class_="right" if h == "posterior" else None) for h in head]
    table = tag("table", tag("thead", tag("tr", cells)), tag("tbody", body), class_="scores")
    note = (
        f"The line at {threshold:.2f}: from there on an effect is fitted with the full simulator, the best first; "
        "effects that may be large are fitted in any case. A dash: it was not fitted, or removes less than a half."
    )
    rest = None
    if quiet:
        few = f"{len(quiet)} more explain less than {LEAST_SHARE:.1%}"
        rest = tag(
            "details", tag("summary", few), tag("p", ", ".join(title(row) for row in quiet), class_="quiet")
        )
    return tag("div", scrolled("Table", table), tag("p", note, class_="quiet small"), rest)


def strength(figure: dict[str, Any]) -> Html | str:
    """A number's interval on a line with zero; nothing without an interval."""
    ends, value = figure.get("ci95"), figure.get("value")
    if not ends or value is None or any(end is None for end in ends):
        return ""
    low, high = min(0.0, *ends, value), max(0.0, *ends, value)
    axes = Axes(220, 26, (low, high), (0, 1), left=8, right=8, top=0, bottom=0)
    return picture(
        220, 26, f"{value:.4g} within {ends[0]:.4g} to {ends[1]:.4g}",
        tag("line", class_="axis", x1=8, x2=212, y1=13, y2=13),
        tag("line", class_="axis", x1=axes.x(0), x2=axes.x(0), y1=6, y2=20),
        tag("line", class_="interval", x1=axes.x(ends[0]), x2=axes.x(ends[1]), y1=13, y2=13),
        tag("circle", class_="after fill", cx=axes.x(value), cy=13, r=4.5),
    )  # fmt: skip


def experiment(suggested: dict[str, Any], sigma: float | None) -> Html | None:
    """The proposed motion of the grips, and how far apart the models' predictions come."""
    controllers = np.asarray(suggested.get("controllers") or np.empty((0, 0, 3)), dtype=float)
    if controllers.ndim != 3 or len(controllers) < 2 or not controllers.shape[1]:
        return None
    moves = MM * (controllers - controllers[0])
    furthest = int(np.argmax(np.abs(moves).max(axis=(0, 2))))
    lines = [
        Series(name, role, list(moves[:, furthest, axis]))
        for axis, (name, role) in enumerate((("x", "measured"), ("y", "before"), ("z", "after")))
    ]
    charts = [
        line_chart(
            suggested["times_s"], lines, title="Proposed motion of a control point", x_label="time [s]",
            y_label="displacement [mm]", height=250, width=540, symmetric=True,
        )
    ]  # fmt: skip
    difference = suggested.get("difference_m") or []
    if len(difference) > 1:
        series = [Series("difference of the predictions", "after", [MM * d for d in difference])]
        if sigma:
            series.append(Series("noise", "noise", [MM * sigma] * len(difference), 1.6, "3 3"))
        charts.append(
            line_chart(
                suggested["frame_times_s"], series, title="Predicted difference", x_label="time [s]",
                y_label="rms difference [mm]", height=250, width=540,
            )
        )  # fmt: skip
    return tag("div", *charts, class_="two")


def _telling(row: dict[str, Any], also: set[Any]) -> bool:
    """Whether a candidate is worth a line: it explains something, or is in the answer."""
    return (
        bool(row.get("selected")) or row.get("name") in also or float(row.get("score") or 0.0) >= LEAST_SHARE
    )


def _candidate(row: dict[str, Any], threshold: float, also: set[Any], posterior: float | None) -> Html:
    role = "chosen" if row.get("selected") else "also" if row.get("name") in also else "other"
    score = max(float(row.get("score") or 0.0), 0.0)
    variant = tag("span", f" {row['variant']}", class_="quiet") if row.get("variant") else None
    bar = tag("div", tag("i", class_=role, style=f"width:{_percent(score)}"), _mark(threshold), class_="bar")
    cells = [
        tag("td", title(row), variant),
        tag("td", bar, tag("span", f"{score:.3f}", class_="value"), class_="bars"),
        tag("td", "–" if posterior is None else f"{posterior:.2f}", class_="right"),
    ]
    return tag("tr", cells, class_=role)


def _mark(threshold: float) -> Html:
    return tag("b", class_="mark", style=f"left:{_percent(threshold)}")


def _percent(share: float) -> str:
    return f"{100 * min(max(share, 0.0), 1.0):.1f}%"


def _picked(found: Residuals) -> Array:
    count = len(found.times)
    return np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).round().astype(int))


def _mm(values: Array) -> list[float | None]:
    return [MM * v if math.isfinite(v) else None for v in values.tolist()]
