"""The confusion matrix of ``benchmarks.trace.power`` as a picture, one panel a level."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trace.power_effects import LEVELS
from benchmarks.trace.power_report import NOT_RUN, SILENT, column
from physworld.effects.registry import EFFECTS

_SIZE = (17.0, 7.5)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture: rows what acts (last: nothing), columns what was answered; shade: share of the row."""
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "trace_power"
    from matplotlib import pyplot

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
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)
