"""Makes ``docs/images/overview.png``, the picture of the README, from a run of the sample scene.

    physworld run sample/soft_beam --out out/soft_beam
    python scripts/make_readme_picture.py out/soft_beam

Left: measured points and the twin's prediction at three frames, seen from the side. Middle: track error of every
frame for two baselines, the twin and the world model. Right: the stages. Everything drawn comes from the scene and
from ``prediction.npz`` in the run's folder; nothing is smoothed. Needs the extra ``dev``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from physworld.evaluate.baselines import rigid_follow, static
from physworld.evaluate.metrics import track_error_per_frame
from physworld.scene import Scene
from physworld_scenes.bundle import read_bundle

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "sample" / "soft_beam"
TARGET = ROOT / "docs" / "images" / "overview.png"

SIZE_INCHES = (11.0, 4.9)
DOTS_PER_INCH = 150
LINE_OF_SIGHT = 1  # the axis of the world that the left panels look along: y
SHARE_OF_TRAINING = 0.5  # the first of the three frames, as a share of the training frames
ROOM_FOR_LEGEND = 5.0  # factor on the logarithmic axis' upper end
MILLIMETRES = 1000.0

INK = "#1f2430"
MUTED = "#6b7280"
COLOURS = {"static": "#9aa1ac", "rigid-follow": "#b8860b", "twin": "#d1495b", "world model": "#1d6fb8"}
STAGES = (
    ("scene", "tracked points, controllers,\nwhat is declared"),
    ("fit", "material from the training\nframes gives the twin"),
    ("dataset", "the twin demonstrates:\nnew motions, varied materials"),
    ("model", "graph network, trained and\npublished as a version"),
)


def main() -> None:
    """Read the run, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="folder that `physworld run --out` wrote, with prediction.npz")
    parser.add_argument("--scene", type=Path, default=SCENE, help="the run's scene (default: the sample)")
    parser.add_argument("--out", type=Path, default=TARGET, help="the picture (default: docs/images)")
    options = parser.parse_args()
    scene = read_bundle(options.scene)
    with np.load(options.run / "prediction.npz") as arrays:
        twin, model = arrays["twin_tracks"].astype(float), arrays["tracks"].astype(float)
    if twin.shape != scene.points.shape:
        raise SystemExit(
            f"{options.run} predicts {twin.shape}, {options.scene} measures {scene.points.shape}"
        )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    draw(scene, twin, model, options.out)
    print(options.out)


def draw(scene: Scene, twin: np.ndarray, model: np.ndarray, target: Path) -> None:
    """The whole figure; ``twin`` and ``model`` are tracks (T, N, 3) [m]."""
    plt.rcParams.update(
        {"font.size": 11, "font.family": "DejaVu Sans", "text.color": INK, "axes.edgecolor": MUTED}
    )
    figure = plt.figure(figsize=SIZE_INCHES, facecolor="white")
    grid = figure.add_gridspec(
        3,
        3,
        width_ratios=(0.95, 1.5, 1.2),
        left=0.015,
        right=0.99,
        top=0.92,
        bottom=0.1,
        wspace=0.3,
        hspace=0.22,
    )
    for row, frame in enumerate(moments(scene)):
        _draw_moment(figure.add_subplot(grid[row, 0]), scene, twin, frame, legend=row == 0)
    _draw_errors(figure.add_subplot(grid[:, 1]), scene, twin, model)
    _draw_stages(figure.add_subplot(grid[:, 2]))
    figure.savefig(target, dpi=DOTS_PER_INCH, facecolor="white", metadata={"Software": None})
    plt.close(figure)


def moments(scene: Scene) -> tuple[int, int, int]:
    """One training frame, the middle of the held-out frames, and the last frame."""
    first, last = scene.test
    return int(SHARE_OF_TRAINING * scene.train[1]), (first + last) // 2, last - 1


def _draw_moment(axes: Axes, scene: Scene, twin: np.ndarray, frame: int, *, legend: bool) -> None:
    across, up = (a for a in range(3) if a != LINE_OF_SIGHT)
    measured, predicted = scene.points[frame, scene.visible[frame]], twin[frame]
    grip = scene.controllers[frame]
    axes.scatter(grip[:, across], grip[:, up], s=26, marker="s", color=COLOURS["static"], label="gripper")
    axes.scatter(measured[:, across], measured[:, up], s=9, color=INK, label="measured", zorder=3)
    axes.scatter(
        predicted[:, across], predicted[:, up], s=44, linewidths=1.1, facecolors="none",
        edgecolors=COLOURS["twin"], label="twin",
    )  # fmt: skip
    width, height = _window(scene, across, up)
    low, high = predicted.min(axis=0), predicted.max(axis=0)
    x, z = 0.5 * (low[across] + high[across]), 0.5 * (low[up] + high[up])
    axes.set(xlim=(x - width / 2, x + width / 2), ylim=(z - height / 2, z + height / 2), xticks=[], yticks=[])
    axes.set_aspect("equal", adjustable="box")
    held_out = frame >= scene.test[0]
    axes.text(
        0.5, -0.04, f"{scene.times[frame]:.2f} s, {'held out' if held_out else 'training'}",
        transform=axes.transAxes, ha="center", va="top", color=COLOURS["twin"] if held_out else MUTED,
    )  # fmt: skip
    if legend:
        axes.legend(
            loc="lower center",
            bbox_to_anchor=(0.5, 0.98),
            ncols=3,
            frameon=False,
            handletextpad=0.0,
            columnspacing=0.7,
        )


def _window(scene: Scene, across: int, up: int) -> tuple[float, float]:
    """Width and height [m] that hold the object in any frame, with a margin."""
    seen = np.where(scene.visible[..., None], scene.points, np.nan)
    extent = np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)
    return 1.1 * float(np.nanmax(extent[:, across])), 1.1 * float(np.nanmax(extent[:, up]))


def _draw_errors(axes: Axes, scene: Scene, twin: np.ndarray, model: np.ndarray) -> None:
    predictions = {
        "static": static(scene),
        "rigid-follow": rigid_follow(scene),
        "twin": twin,
        "world model": model,
    }
    for name, predicted in predictions.items():
        error = MILLIMETRES * track_error_per_frame(predicted, scene.points, scene.visible)
        axes.plot(scene.times[1:], error[1:], color=COLOURS[name], linewidth=2.2, label=name)
    if scene.noise_sigma_m is not None:
        floor = MILLIMETRES * scene.noise_sigma_m * np.sqrt(8.0 / np.pi)
        axes.axhline(floor, color=INK, linewidth=1.0, linestyle=":", label="noise floor")
    split = 0.5 * (scene.times[scene.test[0] - 1] + scene.times[scene.test[0]])
    axes.axvspan(split, scene.times[-1], color="#f3f4f6", zorder=0)
    axes.axvline(split, ymax=0.78, color=MUTED, linewidth=1.0)  # below the legend
    top = axes.get_xaxis_transform()
    axes.text(split, 1.02, "training ", transform=top, ha="right", color=MUTED)
    axes.text(split, 1.02, " held out", transform=top, ha="left", color=COLOURS["twin"])
    axes.set(yscale="log", xlim=(scene.times[1], scene.times[-1]), xlabel="time [s]")
    axes.set_ylabel("track error [mm]", labelpad=2)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylim(top=ROOM_FOR_LEGEND * axes.get_ylim()[1])
    axes.legend(loc="upper center", ncols=2, frameon=False)


def _draw_stages(axes: Axes) -> None:
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.axis("off")
    height, step = 0.18, 0.26
    for number, (name, text) in enumerate(STAGES):
        low = 0.98 - height - number * step
        box = FancyBboxPatch(
            (0.05, low), 0.9, height, boxstyle="round,pad=0.012,rounding_size=0.03", facecolor="#eef4fb",
            edgecolor=COLOURS["world model"], linewidth=1.4,
        )  # fmt: skip
        axes.add_patch(box)
        axes.text(0.5, low + height - 0.035, name, ha="center", va="center", fontweight="bold", fontsize=12.5)
        axes.text(0.5, low + 0.065, text, ha="center", va="center", fontsize=10.5)
        if number + 1 < len(STAGES):
            axes.annotate(
                "", xy=(0.5, low - step + height + 0.012), xytext=(0.5, low - 0.012),
                arrowprops={"arrowstyle": "-|>", "color": COLOURS["world model"], "linewidth": 1.8},
            )  # fmt: skip


if __name__ == "__main__":
    main()
