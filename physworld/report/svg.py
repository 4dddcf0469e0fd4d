"""Charts as SVG that follow the page's colours: axes, lines, bars, intervals. No network, no script."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from physworld.report.markup import Child, Html, scrolled, tag
from physworld.report.predictors import NOISE
from physworld.report.words import number

TICKS, NARROW_TICKS = 5, 4
ROW, ABOVE = 26.0, 12.0
"""Height of a row of an interval chart, and of a label above it [px]."""
DWARFS = 10.0
"""Ratio of the largest line of a chart to the smallest from which on the axis is logarithmic."""


@dataclass(frozen=True)
class Series:
    """A line: values (None or NaN: a gap) over the chart's x, its colour's role, and how it is drawn."""

    label: str
    role: str
    values: Sequence[float | None]
    width: float = 2.0
    dash: str | None = None


@dataclass(frozen=True)
class Axes:
    """A drawing area with its scales; lengths in the picture's own units (pixels at full width)."""

    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    left: float = 54.0
    right: float = 14.0
    top: float = 18.0
    bottom: float = 40.0
    log_y: bool = False
    ticks: int = TICKS
    """About how many numbers the horizontal axis has."""

    def x(self, value: float) -> float:
        """Place across."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low or 1.0) * (self.width - self.left - self.right)

    def y(self, value: float) -> float:
        """Place down; below the range of a logarithmic axis at its foot."""
        low, high = self.y_range
        if self.log_y:
            value, low, high = (math.log10(max(v, self.y_range[0])) for v in (value, low, high))
        return (
            self.height
            - self.bottom
            - (value - low) / (high - low or 1.0) * (self.height - self.top - self.bottom)
        )

    def grid(self, x_label: str, y_label: str) -> list[Html]:
        """Lines and numbers of both axes."""
        parts = []
        ticks = decades(*self.y_range) if self.log_y else round_ticks(*self.y_range)
        for tick in ticks:
            y = self.y(tick)
            parts.append(tag("line", class_="grid", x1=self.left, x2=self.width - self.right, y1=y, y2=y))
            parts.append(tag("text", short(tick), class_="tick", x=self.left - 8, y=y + 4, text_anchor="end"))
        foot = self.height - self.bottom
        for tick in round_ticks(*self.x_range, self.ticks):
            x = self.x(tick)
            parts.append(tag("line", class_="axis", x1=x, x2=x, y1=foot, y2=foot + 4))
            parts.append(tag("text", short(tick), class_="tick", x=x, y=foot + 17, text_anchor="middle"))
        parts.append(tag("line", class_="axis", x1=self.left, x2=self.width - self.right, y1=foot, y2=foot))
        middle = 0.5 * (self.left + self.width - self.right)
        parts.append(tag("text", x_label, class_="label", x=middle, y=self.height - 5, text_anchor="middle"))
        parts.append(
            tag("text", y_label, class_="label", transform=f"translate(13 {0.5 * (self.top + foot):.1f}) rotate(-90)",
                text_anchor="middle")
        )  # fmt: skip
        return parts

    def line(self, x: Sequence[float], series: Series) -> Html:
        """A line with gaps where values are missing."""
        path, pen = [], "M"
        for at, value in zip(x, series.values, strict=True):
            if value is None or not math.isfinite(value):
                pen = "M"
                continue
            path.append(f"{pen}{self.x(at):.1f} {self.y(value):.1f}")
            pen = "L"
        return tag(
            "path", class_=f"line {series.role}", d="".join(path), stroke_width=series.width,
            stroke_dasharray=series.dash,
        )  # fmt: skip


def picture(
    width: float, height: float, title: str, *children: Child, kind: str = "", **attributes: str
) -> Html:
    """An SVG element with a name for those who hear the page.

    Args:
        width, height: of its coordinates.
        title: the name.
        children: what is drawn.
        kind: a further class.
        attributes: further ones of the element.
    """
    return tag(
        "svg", tag("title", title), *children, class_=f"chart {kind}".strip(),
        viewBox=f"0 0 {width:g} {height:g}", role="img", **attributes,
    )  # fmt: skip


def legend(entries: Sequence[tuple[str, str, str | None]]) -> Html:
    """Labels with samples of their lines: (label, role, dash)."""
    items = [
        tag(
            "span",
            tag(
                "svg",
                tag("line", class_=f"line {role}", x1=0, x2=22, y1=6, y2=6, stroke_width=2.5, stroke_dasharray=dash),
                viewBox="0 0 22 12", aria_hidden="true",
            ),
            label,
        )
        for label, role, dash in entries
    ]  # fmt: skip
    return tag("div", *items, class_="legend")


def legend_of(series: Sequence[Series]) -> Html | None:
    """The legend of lines; none for a single one."""
    return legend([(s.label, s.role, s.dash) for s in series]) if len(series) > 1 else None


def line_chart(
    x: Sequence[float],
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    split: float | None = None,
    log_y: bool = False,
    height: float = 270.0,
    width: float = 720.0,
    narrow: float | None = None,
    symmetric: bool = False,
    named: bool = True,
    unit: str = "",
) -> Html:
    """Lines over x, with a legend if ``named``; what lies after ``split`` is shaded as held out.

    The figure carries its numbers as JSON (``data-x``, ``data-series``), for a page to tell those under a pointer.

    Args:
        x: places along the horizontal axis, (n,).
        series: curves of n values each.
        title, x_label, y_label: texts.
        split: where the held-out frames begin on the horizontal axis.
        log_y: logarithmic vertical axis.
        height, width: [px].
        narrow: width of a second drawing for small windows [px], see :func:`drawings`; None: without one.
        symmetric: zero in the middle of the vertical axis.
        named: curves are named.
        unit: of the values.
    """
    values = [v for s in series for v in s.values if v is not None and math.isfinite(v)]
    x_range = (float(x[0]), float(x[-1])) if len(x) > 1 else (0.0, 1.0)
    y_range = _range(values, log_y, symmetric)

    def drawn(across: float, ticks: int, kind: str) -> Html:
        axes = Axes(across, height, x_range, y_range, log_y=log_y, ticks=ticks)
        foot = axes.height - axes.bottom
        parts: list[Child] = []
        if split is not None and x_range[0] < split < x_range[1]:
            left = axes.x(split)
            parts.append(
                tag("rect", class_="held", x=left, y=axes.top, width=axes.width - axes.right - left,
                    height=foot - axes.top)
            )  # fmt: skip
            parts.append(tag("text", "held out", class_="note", x=left + 2, y=axes.top - 4))
        parts += axes.grid(x_label, y_label)
        parts += [axes.line(x, one) for one in series]
        parts.append(tag("line", class_="playhead", x1=axes.left, x2=axes.left, y1=axes.top, y2=foot))
        return picture(
            axes.width, axes.height, title, *parts, kind=kind, data_time=f"{x_range[0]:.6g} {x_range[1]:.6g}",
            data_span=f"{axes.left:g} {axes.width - axes.right:g}",
        )  # fmt: skip

    numbers = [{"label": s.label, "role": s.role, "values": [_plain(v) for v in s.values]} for s in series]
    return tag(
        "figure", scrolled(title, drawings(drawn, width, narrow)), legend_of(series) if named else None,
        class_="plot", data_x=json.dumps([_plain(v) for v in x]), data_series=json.dumps(numbers), data_unit=unit,
    )  # fmt: skip


def drawings(drawn: Callable[[float, int, str], Html], width: float, narrow: float | None) -> list[Html]:
    """A chart, and the same for small windows, where text that shrinks with the picture could not be read.

    The style sheet shows the one with the class ``wide`` or the one with ``narrow``; a single one has neither.

    Args:
        drawn: makes a picture of a width [px], a number of ticks across and a class.
        width, narrow: the widths [px]; ``narrow`` None: only the first.
    """
    if narrow is None:
        return [drawn(width, TICKS, "")]
    return [drawn(width, TICKS, "wide"), drawn(narrow, NARROW_TICKS, "narrow")]


def dwarfed(series: Sequence[Series]) -> bool:
    """Whether some lines are so small beside the others that only a logarithmic axis shows both."""
    highest = [max((v for v in s.values if v is not None and math.isfinite(v)), default=0.0) for s in series]
    positive = [value for value in highest if value > 0]
    return len(positive) > 1 and max(positive) > DWARFS * min(positive)


@dataclass(frozen=True)
class Interval:
    """A row of an interval chart: its label, its role, the value, and the ends of its interval where there is one."""

    label: str
    role: str
    value: float
    ends: tuple[float, float] | None = None


def interval_chart(
    rows: Sequence[Interval],
    *,
    title: str,
    x_label: str,
    floor: float | None = None,
    log_x: bool = False,
    width: float = 720.0,
    narrow: float | None = None,
) -> Html:
    """Values with their intervals, one a row, smallest at the left; ``floor`` is a line that no row can be left of.

    Args:
        rows: what is compared, from the top.
        title, x_label: texts.
        floor: noise floor, say, in the unit of the values; None: no line.
        log_x: logarithmic axis.
        width: [px].
        narrow: width of a second drawing for small windows [px], whose labels stand above the rows; None: without one.
    """
    held = [v for row in rows for v in (row.value, *(row.ends or ())) if math.isfinite(v)]
    low, high = _range(held + ([] if floor is None else [floor]), log_x, False)

    def drawn(across: float, ticks: int, kind: str) -> Html:
        above = kind == "narrow"
        step = ROW + ABOVE if above else ROW
        left = 14.0 if above else 230.0
        axes = Axes(across, step * len(rows) + 62.0, (low, high), (0.0, 1.0), left=left, top=8.0, bottom=44.0)
        return picture(axes.width, axes.height, title, *_rows(axes, step, above, ticks), kind=kind)

    def _rows(axes: Axes, step: float, above: bool, ticks: int) -> list[Child]:
        def place(value: float) -> float:
            if not log_x:
                return axes.x(value)
            share = (math.log10(max(value, low)) - math.log10(low)) / (math.log10(high) - math.log10(low))
            return axes.left + share * (axes.width - axes.left - axes.right)

        foot = axes.height - axes.bottom
        parts: list[Child] = []
        for tick in decades(low, high) if log_x else round_ticks(low, high, ticks):
            x = place(tick)
            parts.append(tag("line", class_="grid", x1=x, x2=x, y1=axes.top, y2=foot))
            parts.append(tag("text", short(tick), class_="tick", x=x, y=foot + 16, text_anchor="middle"))
        if floor is not None:
            x = place(floor)
            ends = {"x1": x, "x2": x, "y1": axes.top, "y2": foot}
            parts.append(
                tag("line", class_=f"line {NOISE}", stroke_width=1.6, stroke_dasharray="3 3", **ends)
            )
        for number_of, row in enumerate(rows):
            y = axes.top + step * (number_of + 1) - ROW / 2
            label = {"x": 0.0, "y": y - 14} if above else {"x": axes.left - 12, "y": y + 4}
            parts.append(
                tag("text", row.label, class_="above" if above else None, text_anchor="start" if above else "end",
                    **label)
            )  # fmt: skip
            if row.ends is not None and all(map(math.isfinite, row.ends)):
                left, right = map(place, row.ends)
                parts.append(
                    tag("line", class_=f"line {row.role}", x1=left, x2=right, y1=y, y2=y, stroke_width=2.5)
                )
            if math.isfinite(row.value):
                parts.append(tag("circle", class_=f"dot {row.role}", cx=place(row.value), cy=y, r=4.5))
        middle = 0.5 * (axes.left + axes.width - axes.right)
        parts.append(tag("text", x_label, class_="label", x=middle, y=axes.height - 6, text_anchor="middle"))
        return parts

    return tag("figure", scrolled(title, drawings(drawn, width, narrow)), class_="plot")


def _plain(value: float | None) -> float | None:
    """A number as JSON has it, no more exact than a picture needs."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")


def round_ticks(low: float, high: float, count: int = TICKS) -> list[float]:
    """Round numbers within a range, about ``count``."""
    if not high > low:
        return [low]
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(f * power for f in (1, 2, 2.5, 5, 10) if f * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def decades(low: float, high: float) -> list[float]:
    """1, 2 and 5 of every power of ten within a range; powers only where those are many."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1,) if high > 100.0 * low else (1, 2, 5)
    return [f * 10.0**p for p in powers for f in factors if low <= f * 10.0**p <= high]


def short(value: float) -> str:
    """A tick's number."""
    return f"{value:.6g}" if 1e-4 <= abs(value) < 1e6 or value == 0 else number(value, 2)


def _range(values: list[float], log_y: bool, symmetric: bool) -> tuple[float, float]:
    high, low = max(values, default=1.0), min(values, default=0.0)
    if log_y:
        positive = [v for v in values if v > 0]
        low = min(positive, default=0.1)
        return max(0.8 * low, 1e-3 * high or 1e-3), 1.25 * high or 1.0
    if symmetric:
        most = 1.08 * max(abs(low), abs(high)) or 1.0
        return -most, most
    return min(low, 0.0), 1.08 * high if high > 0 else 1.0
