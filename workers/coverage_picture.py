"""The picture of a dataset's card: what its episodes cover, as SVG and PNG.

Motions with their rejected tries; speed and reach of the control points; spread of the stiffness; where the material
was, seen from the front and from above. Colours are those of the dashboard; the same figures give the same bytes.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.coverage import Coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, RED, GREY = "#2f6fb0", "#c4513f", "#8a8f98"
SIZE_INCHES = (11.0, 6.4)
DPI = 110
BINS = 30
GRID = 80


def coverage_pictures(coverage: Coverage) -> tuple[bytes, bytes]:
    """SVG and PNG of one page."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(
        {
            "svg.hashsalt": "physworld",
            "font.size": 8.5,
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    ):
        figure = Figure(figsize=SIZE_INCHES, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, 3)
        _motions(axes[0, 0], coverage)
        _speeds(axes[0, 1], coverage)
        _scatter(axes[0, 2], coverage)
        _stiffness(axes[1, 0], coverage)
        places = np.concatenate(coverage.places)
        _occupancy(axes[1, 1], places, 0, 2)
        _occupancy(axes[1, 2], places, 0, 1)
        drawing = _saved(figure, "svg", metadata={"Date": None})
        figure.set_layout_engine(None)  # all is in its place by now
        return drawing, _saved(figure, "png", dpi=DPI)


def _saved(figure: Figure, kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def _motions(axes: Axes, coverage: Coverage) -> None:
    rejected = [str(one.get("motion", "")) for one in coverage.rejections]
    names = sorted(set(coverage.motions) | set(rejected), key=lambda name: -coverage.motions[name])
    kept = [coverage.motions[name] for name in names]
    refused = [rejected.count(name) for name in names]
    rows = np.arange(len(names))
    axes.barh(rows, kept, color=BLUE, label="kept")
    if any(refused):
        axes.barh(rows, refused, left=kept, color=RED, label="rejected")
        axes.legend(frameon=False)
    axes.set_yticks(rows, [name.replace("_", " ") or "not planned" for name in names])
    axes.invert_yaxis()
    axes.set(title="Motions", xlabel="tries")


def _speeds(axes: Axes, coverage: Coverage) -> None:
    axes.hist(np.concatenate(coverage.speeds), bins=BINS, color=BLUE)
    axes.set_yscale("log")
    axes.set(title="Speed of the fastest control point", xlabel="m/s", ylabel="ticks")


def _scatter(axes: Axes, coverage: Coverage) -> None:
    axes.scatter(
        coverage.column("reach_m"), coverage.column("peak_speed_m_s"), s=7, color=BLUE, alpha=0.6, lw=0
    )
    axes.set(title="Reach and peak speed of each episode", xlabel="reach, m", ylabel="m/s")


def _stiffness(axes: Axes, coverage: Coverage) -> None:
    mean, spread = coverage.column("log_modulus_mean"), coverage.column("log_modulus_std")
    axes.scatter(np.exp(mean), spread, s=7, color=BLUE, alpha=0.6, lw=0)
    axes.axvline(1.0, color=GREY, lw=0.8)
    axes.set(
        title="Stiffness of each episode",
        xlabel="geometric mean, times the fitted one",
        ylabel="spread in the log",
    )


def _occupancy(axes: Axes, places: Array, across: int, up: int) -> None:
    counts, x, y = np.histogram2d(places[:, across], places[:, up], bins=GRID)
    shown = np.log10(np.where(counts > 0.0, counts, np.nan)).T
    axes.pcolormesh(x, y, shown, cmap="Blues", vmin=-1.0, rasterized=True)
    axes.set_aspect("equal", adjustable="datalim")
    names = "xyz"
    axes.set(
        title=f"Where the material was, {names[across]}{names[up]}",
        xlabel=f"{names[across]}, m",
        ylabel=f"{names[up]}, m",
    )
