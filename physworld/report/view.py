"""The 3D view: measured and predicted points over time, before beside after, coloured by their residual."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.report.curves import Residuals, per_point
from physworld.report.markup import Html, tag
from physworld.scene import Scene

MOST_FRAMES, MOST_POINTS = 240, 600
_STEPS = 32767
_MISSING = -32768


def view(scene: Scene, before: Array, after: Array, found: Residuals) -> Html:
    """Canvases with their data and controls; the script is :func:`script`.

    Args:
        scene: what was measured.
        before, after: predictions, (T, N, 3) [m].
        found: the residuals of both.
    """
    panes = [("before", "Twin" if found.same else "Before")] + ([] if found.same else [("after", "After")])
    canvases = [
        tag(
            "figure",
            tag("figcaption", tag("span", name), tag("span", class_="rms", data_rms=role)),
            tag("canvas", data_pane=role, tabindex=0, aria_label=f"{name}: points in space, drag to turn"),
            class_="pane",
        )
        for role, name in panes
    ]
    options = [("now", "at this moment"), ("train", "over the training frames")]
    if found.split < len(found.times):
        options.append(("test", "over the held-out frames"))
    select = tag("select", [tag("option", text, value=value) for value, text in options], data_mode=True)
    controls = tag(
        "div",
        tag("button", "Play", type="button", data_play=True),
        tag("input", type="range", min=0, value=0, step=1, data_slider=True, aria_label="frame"),
        tag("output", data_clock=True),
        tag("label", "colour: residual ", select),
        class_="controls",
    )  # fmt: skip
    legend = tag(
        "div",
        tag("span", tag("i", class_="ring"), "measured"),
        tag("span", tag("i", class_="disc"), "predicted, by its residual"),
        tag("span", "0", tag("i", class_="scale"), tag("em", data_top=True)),
        tag("span", "drag to turn, wheel to zoom", class_="quiet"),
        class_="legend",
    )
    data = json.dumps(_data(scene, before, after, found), allow_nan=False).replace("<", "\\u003c")
    store = tag("script", Html(data), type="application/json", data_points=True)
    return tag("div", tag("div", *canvases, class_="panes"), controls, legend, store, class_="view")


def script() -> str:
    """The view's script."""
    return files(__package__).joinpath("viewer.js").read_text()


def _data(scene: Scene, before: Array, after: Array, found: Residuals) -> dict[str, Any]:
    frames = np.unique(
        np.linspace(0, len(scene.times) - 1, min(len(scene.times), MOST_FRAMES)).round().astype(int)
    )
    count = scene.points.shape[1]
    points = np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int))
    chosen = np.ix_(frames, points)
    measured = np.where(scene.visible[chosen][..., None], scene.points[chosen], np.nan)
    clouds = {"measured": measured, "before": before[chosen]}
    if not found.same:
        clouds["after"] = after[chosen]
    grips = scene.controllers[frames] if scene.controllers.shape[1] else np.empty((len(frames), 0, 3))
    shown = np.concatenate([c.reshape(-1, 3) for c in (*clouds.values(), grips)])
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    size = float(max((high - low).max(), 1e-6))
    windows = {"train": slice(0, found.split), "test": slice(found.split, None)}
    return {
        "times": np.round(scene.times[frames], 4).tolist(),
        "split": int(np.searchsorted(frames, found.split)),
        "count": len(points),
        "low": low.tolist(),
        "size": size,
        "high": high.tolist(),
        "clouds": {name: _packed(cloud, low, size) for name, cloud in clouds.items()},
        "grips": _packed(grips, low, size),
        "grip_count": int(grips.shape[1]),
        "edges": _edges(scene, points),
        "floor": None if scene.ground is None else float(scene.ground.height_m),
        "rms": {
            name: {
                window: [
                    None if not np.isfinite(v) else float(f"{v:.4g}")
                    for v in per_point(residual[cut])[points]
                ]
                for window, cut in windows.items()
                if len(residual[cut])
            }
            for name, residual in (("before", found.before), ("after", found.after))
        },
    }


def _packed(cloud: Array, low: Array, size: float) -> str:
    """Places in steps of the view's size over 32767, little-endian int16, base64."""
    finite = np.isfinite(cloud)
    steps = np.clip(np.round((np.where(finite, cloud, low) - low) / size * _STEPS), -_STEPS, _STEPS)
    return base64.b64encode(np.where(finite, steps, _MISSING).astype("<i2").tobytes()).decode()


def _edges(scene: Scene, points: Array) -> list[list[int]]:
    """The declared topology between the points that are shown."""
    if scene.body.edges is None:
        return []
    place = {int(p): k for k, p in enumerate(points)}
    return [
        [place[int(a)], place[int(b)]] for a, b in scene.body.edges if int(a) in place and int(b) in place
    ]
