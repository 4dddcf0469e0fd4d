"""Pictures of ``benchmarks.trace.power``: the confusion matrix, one panel a level; how often claims are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trace.power_effects import LEVELS
from benchmarks.trace.power_report import NOT_RUN, SILENT, column
from physworld.effects.registry import EFFECTS

_SIZE = (17.0, 7.5)
_CURVE_SIZE = (4.5, 3.5)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture: rows what acts (last: nothing), columns what was answered; shade: share of the row."""
    pyplot = _pyplot()
    acts, answers = [*EFFECTS, None], [*EFFECTS, *SILENT]
    figure, axes = pyplot.subplots(1, len(LEVELS), figsize=_SIZE, sharey=True, layout="constrained")
    for axis, level in zip(axes, LEVELS, strict=True):
        counts = np.zeros((len(acts), len(answers)), dtype=int)
        for row in rows:
            if row["outcome"] not in NOT_RUN and row["level"] in (level, 0.0):
                counts[acts.index(row["effect"]), answers.index(column(row))] += 1
        total = counts.sum(axis=1, keepdims=True)
        share = np.where(total > 0, counts / np.maximum(total, 1), np.nan)
        axis.imshow(np.where(counts > 0, share, np.nan), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
        for i, j in zip(*np.nonzero(counts), strict=True):
            dark = share[i, j] > 0.6
            axis.text(
                j, i, counts[i, j], ha="center", va="center", fontsize=6, color="white" if dark else "black"
            )
        axis.set_xticks(range(len(answers)), [a.replace("_", " ") for a in answers], rotation=90, fontsize=6)
        axis.set_yticks(range(len(acts)), [(a or "nothing").replace("_", " ") for a in acts], fontsize=7)
        axis.axvline(len(EFFECTS) - 0.5, color="grey", linewidth=0.8)
        axis.axhline(len(EFFECTS) - 0.5, color="grey", linewidth=0.8)
        axis.set_title(f"displaced by {level:g} times the noise", fontsize=9)
        axis.set_xlabel("answer", fontsize=8)
    axes[0].set_ylabel("what acts", fontsize=8)
    _write(figure, path)


def draw_calibration(bins: list[dict[str, float]], path: Path) -> None:
    """Write the picture: the share of claims that are right, with its interval, over their mean posterior."""
    pyplot = _pyplot()
    figure, axis = pyplot.subplots(figsize=_CURVE_SIZE, layout="constrained")
    axis.plot([0, 1], [0, 1], color="grey", linewidth=0.8, label="calibrated")
    known = [one for one in bins if one["claims"]]
    share = np.array([one["right"] / one["claims"] for one in known])
    ends = np.array([[one["low"], one["high"]] for one in known]).reshape(-1, 2).T
    axis.errorbar(
        [one["claimed"] for one in known], share, yerr=np.abs(ends - share), fmt="o-", markersize=4, capsize=3
    )
    for one, right in zip(known, share, strict=True):
        axis.annotate(
            f"{one['claims']}", (one["claimed"], right), (4, -10), textcoords="offset points", fontsize=7
        )
    axis.set_xlabel("posterior of a claim", fontsize=8)
    axis.set_ylabel("share that is right (95 %)", fontsize=8)
    axis.legend(fontsize=7)
    _write(figure, path)


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "trace_power"
    from matplotlib import pyplot

    return pyplot


def _write(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    _pyplot().close(figure)
