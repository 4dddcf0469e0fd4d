"""``python -m scripts.make_concept_figures [--measure]``: the figures of the pages that explain the concepts.

``docs/images/concept_NAME.svg`` of the pages method, calibration, trace and models. Curves and bars are measured: of
the sample scene, and of the bar of ``docs/notebooks/missing_effect.ipynb``. ``--measure`` measures them anew (some
minutes) and keeps them in ``docs/images/concepts.json``; without it the figures are drawn from that file. Every
figure stands on a light card, so that it reads on a dark page too.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld_scenes.bundle import read_bundle

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
MEASURED = IMAGES / "concepts.json"
SAMPLE = ROOT / "sample" / "soft_beam"
NOTEBOOK = ROOT / "docs" / "notebooks" / "missing_effect.ipynb"
PARTICLES = 500
STIFFNESSES_PA = np.geomspace(1e4, 1e7, 25)
SCANNED = 4  # each so many-th of them is a step of the scan

CARD, EDGE, INK, MUTED = "#fbfbfc", "#d5d9e0", "#1f2430", "#5b6472"
TWIN, MODEL, POINT, GRIP, FLOOR = "#c2384b", "#1d6fb8", "#1f2430", "#b8860b", "#3a8f5c"
FONT = "system-ui, -apple-system, 'Segoe UI', Helvetica, Arial, sans-serif"


def main() -> None:
    """Measure if asked, then draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--measure", action="store_true", help="simulate anew what the figures show")
    if parser.parse_args().measure:
        MEASURED.write_text(json.dumps({"calibration": _scan(), "trace": _trace()}, indent=1) + "\n")
    for name, text in figures(json.loads(MEASURED.read_text())).items():
        (IMAGES / f"concept_{name}.svg").write_text(text)


def figures(measured: dict[str, Any]) -> dict[str, str]:
    """The SVG of every page by its name."""
    return {
        "method": _method(),
        "calibration": _calibration(measured["calibration"]),
        "trace": _trace_figure(measured["trace"]),
        "models": _models(),
    }


# what is measured


def _scan() -> dict[str, Any]:
    """Error of the sample's twin over its stiffness, and what a calibration finds."""
    scene = read_bundle(SAMPLE)
    twin = build_twin(scene, PARTICLES)

    def error_mm(tried: Twin) -> float:
        tracks = tried.observe(tried.simulate_nodes(*scene.control_track(), scene.times), scene.times)
        seen = scene.visible[slice(*scene.train)]
        return round(1e3 * _rms((tracks - scene.points)[slice(*scene.train)][seen]), 3)

    found = calibrate(scene, CalibrationConfig(particle_budget=PARTICLES))
    best = found.parameters["youngs_modulus_pa"].value
    tried = {
        name: [round(float(value)) for value in values]
        for name, values in (("scan", STIFFNESSES_PA), ("valley", best * np.geomspace(0.75, 1.3, 25)))
    }
    return {
        **{
            name: {
                "youngs_modulus_pa": values,
                "training_rms_mm": [error_mm(twin.with_parameters(youngs_modulus_pa=v)) for v in values],
            }
            for name, values in tried.items()
        },
        "noise_mm": 1e3 * float(scene.noise_sigma_m or 0.0),
        "found": {"youngs_modulus_pa": round(best), "training_rms_mm": error_mm(found.twin)},
    }


def _trace() -> dict[str, Any]:
    """The trace of the notebook, by its own cells: errors of every frame, and the sets of effects."""
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    for cell in cells[:2]:
        exec("".join(cell["source"]), names)
    found = names["trace"](names["scene"], names["config"])
    scene, report = names["scene"], names["report"]
    return {
        "times_s": [round(float(time), 4) for time in scene.times],
        "before_mm": [round(1e3 * _rms(error), 3) for error in found.before - scene.points],
        "after_mm": [round(1e3 * _rms(error), 3) for error in found.after - scene.points],
        "noise_mm": 1e3 * float(scene.noise_sigma_m),
        "training_frames": scene.train[1],
        "effect": report["effects"][0]["name"],
        "parameters": report["effects"][0]["parameters"],
        "hypotheses": [
            {
                key: one[key] if key == "effects" else round(one[key], 3)
                for key in ("effects", "posterior", "left_out")
            }
            for one in report["hypotheses"]
        ],
    }


def _rms(error: Array) -> float:
    """Root mean square per axis."""
    return float(np.sqrt(np.mean(error**2)))


# the figures


def _method() -> str:
    """From a recording over the twin and its demonstrations to the model, and which frames measure them."""
    width, foot = 880, 236
    parts, step = [], 216
    titles = ("recording", "twin", "demonstrations", "world model")
    told = ("points and grips", "a calibrated simulation", "new motions of the twin", "a fast graph network")
    for number, (title, text) in enumerate(zip(titles, told, strict=True)):
        left = 24 + number * step
        parts += [_box(left, 28, 184, 150), _text(left + 92, 52, title, weight=600)]
        parts.append(_text(left + 92, 168, text, MUTED, 12))
        if number:
            parts.append(_arrow(left - 30, 103, left - 4, 103))
            verb = ("calibrate", "demonstrate", "train")[number - 1]
            parts.append(_text(left - 16, 20, verb, MUTED, 12))
    middle = [24 + number * step + 92 for number in range(4)]
    parts += [_dots(_bent(middle[0], 44.0), POINT, 2.6), _grip(middle[0])]
    parts += [*_lattice(middle[1]), _dots(_bent(middle[1], 44.0), POINT, 1.8), _grip(middle[1])]
    for number, (rise, colour) in enumerate(((-20, 0.95), (-6, 0.75), (8, 0.55), (22, 0.4))):
        start = (middle[2] - 62, 108)
        parts.append(
            f'<path d="M{start[0]} {start[1]} C{middle[2] - 20} {96 - 2 * rise} {middle[2] + 8} {100 + 2 * rise} '
            f'{middle[2] + 60 - 6 * number} {104 + rise}" fill="none" stroke="{GRIP}" stroke-width="2" '
            f'opacity="{colour}"/>'
        )
    parts.append(_grip(middle[2]))
    nodes = _bent(middle[3], 44.0)[::2]
    for i, a in enumerate(nodes):
        for b in nodes[i + 1 :]:
            if np.hypot(*(a - b)) < 38:
                parts.append(_line(*a, *b, MODEL, 1.2))
    parts += [_dots(nodes, MODEL, 4.0), _grip(middle[3])]
    parts.append(
        _frames(
            24, foot - 34, width - 48, 0.7, "training frames: calibration and fine-tuning use these alone"
        )
    )
    return _card(width, foot, parts)


def _calibration(found: dict[str, Any]) -> str:
    """The misfit over the stiffness: a scan over decades, then Gauss-Newton down to the noise."""
    width, height = 880, 300
    places = {
        name: list(zip(found[name]["youngs_modulus_pa"], found[name]["training_rms_mm"], strict=True))
        for name in ("scan", "valley")
    }
    area = _Area((70, 30, 560, 236), (4.0, 7.0), (math.log10(0.8), math.log10(200.0)))
    parts = area.axes(
        [(math.log10(v), _power(v)) for v in (1e4, 1e5, 1e6, 1e7)],
        [(math.log10(v), f"{v:g}") for v in (1, 10, 100)],
        "Young's modulus [Pa]",
        "error on the training frames [mm]",
    )
    floor = area.y(math.log10(found["noise_mm"]))
    parts += [_line(area.left, floor, area.right, floor, FLOOR, 1.5, "5 4")]
    parts.append(_text(area.left + 8, floor - 7, "noise that the scene declares", FLOOR, 12, anchor="start"))

    def drawn(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(area.x(math.log10(stiffness)), area.y(math.log10(error))) for stiffness, error in points]

    parts.append(_polyline(drawn(sorted([*places["scan"], *places["valley"]])), TWIN, 1.6, 0.55))
    scanned = drawn(places["scan"][::SCANNED])
    parts.append(_dots(scanned, TWIN, 4.5))
    best = max(scanned, key=lambda point: point[1])
    (goal,) = drawn([(found["found"]["youngs_modulus_pa"], found["found"]["training_rms_mm"])])
    parts.append(_arrow(best[0] + 14, best[1] + 12, goal[0] + 8, goal[1] - 8, INK))
    parts.append(
        f'<circle cx="{goal[0]:.1f}" cy="{goal[1]:.1f}" r="6" fill="none" stroke="{INK}" stroke-width="2"/>'
    )
    steps = (
        (TWIN, "1. Scan", "the stiffness over its decades,", "on a first window of frames"),
        (INK, "2. Descend", "from the best starts by Gauss-Newton,", "in the end on all training frames"),
        (
            MUTED,
            "3. Free more",
            "drag, friction, Poisson's ratio, …",
            "one by one, while each earns its place",
        ),
        (FLOOR, "4. Say how sure", "95 % intervals; what the data", "do not fix returns to its prior"),
    )
    for number, (colour, title, *lines) in enumerate(steps):
        y = 50 + 58 * number
        parts.append(f'<circle cx="600" cy="{y - 5}" r="5" fill="{colour}"/>')
        parts.append(_text(616, y, title, INK, 14, anchor="start", weight=600))
        parts += [
            _text(616, y + 17 * (k + 1), text, MUTED, 12.5, anchor="start") for k, text in enumerate(lines)
        ]
    return _card(width, height, parts)


def _trace_figure(found: dict[str, Any]) -> str:
    """Errors of every frame before and after, and how well each candidate explains what is left."""
    width, height = 880, 290
    times, held = np.array(found["times_s"]), found["times_s"][found["training_frames"]]
    top = 1.15 * max(found["before_mm"])
    area = _Area((66, 34, 440, 228), (0.0, float(times[-1])), (0.0, top))
    parts = [
        f'<rect x="{area.x(held):.1f}" y="{area.top}" width="{area.right - area.x(held):.1f}" '
        f'height="{area.bottom - area.top}" fill="#eceff4"/>',
        _text(0.5 * (area.x(held) + area.right), area.top - 8, "held out", MUTED, 12),
    ]
    parts += area.axes(
        [(v, f"{v:g}") for v in (0, 0.2, 0.4, 0.6, 0.8)],
        [(v, f"{v:g}") for v in (0, 2, 4, 6, 8) if v < top],
        "time [s]",
        "error of the twin [mm]",
    )
    floor = area.y(found["noise_mm"])
    parts.append(_line(area.left, floor, area.right, floor, FLOOR, 1.5, "5 4"))
    for key, colour in (("before_mm", TWIN), ("after_mm", MODEL)):
        points = [(area.x(t), area.y(v)) for t, v in zip(times, found[key], strict=True)]
        parts.append(_polyline(points, colour, 2.2))
    parts.append(_text(area.x(0.02), area.y(0.93 * top), "declared physics", TWIN, 12.5, anchor="start"))
    parts.append(
        _text(area.x(0.02), area.y(0.83 * top), "with the effect that was found", MODEL, 12.5, anchor="start")
    )
    parts.append(_text(area.x(0.02), area.y(0.73 * top), "noise", FLOOR, 12.5, anchor="start"))
    left, wide = 640, 90
    parts.append(
        _text(500, 30, "error on left-out frames, over the noise", INK, 13, anchor="start", weight=600)
    )
    rows = found["hypotheses"]
    scale = wide / max(one["left_out"] for one in rows)
    for number, one in enumerate(rows):
        y = 54 + 30 * number
        name = " + ".join(one["effects"]).replace("_", " ") or "declared physics"
        colour = MODEL if one["effects"] == [found["effect"]] else TWIN if not one["effects"] else "#b9bfc9"
        parts.append(_text(left - 10, y + 13, name.removesuffix(" kelvin voigt"), INK, 12.5, anchor="end"))
        parts.append(
            f'<rect x="{left}" y="{y}" width="{scale * one["left_out"]:.1f}" height="18" rx="3" fill="{colour}"/>'
        )
        told = f"{one['left_out']:.2f}, posterior {one['posterior']:.2f}"
        x = left + scale * max(one["left_out"], 1.0)
        parts.append(_text(x + 8, y + 13, told, INK, 11.5, anchor="start"))
    one = left + scale
    foot = 54 + 30 * len(rows)
    parts.append(_line(one, 48, one, foot - 8, FLOOR, 1.5, "5 4"))
    (name, strength), *_ = found["parameters"].items()
    low, high = strength["ci95"]
    said = f"{found['effect'].replace('_', ' ')}: {strength['value']:.2f} {strength['unit']}"
    parts.append(_text(500, foot + 24, said, MODEL, 14, anchor="start", weight=600))
    parts.append(
        _text(
            500,
            foot + 43,
            f"95 %: {low:.2f} to {high:.2f}; the bar was made with 4",
            MUTED,
            12.5,
            anchor="start",
        )
    )
    return _card(width, height, parts)


def _models() -> str:
    """One step: history and grips go through the prior and the network; the sum is the next history."""
    width, height = 880, 250
    seen = ("the last places of all vertices", "the grips' next motion", "properties Φ")
    following = ("x = x̂ + σ · y", "places of all vertices, 1/30 s later", "measured points by the skin")
    boxes = (
        (20, 70, 206, 96, INK, "what a step sees", seen),
        (286, 36, 230, 66, GRIP, "prior", ("linear, in closed form: x̂",)),
        (286, 134, 230, 66, MODEL, "graph network", ("what the prior leaves: σ · y",)),
        (630, 70, 226, 96, INK, "the next tick", following),
    )
    parts = []
    for left, top, wide, high, colour, title, lines in boxes:
        parts.append(_box(left, top, wide, high, colour))
        parts.append(_text(left + wide / 2, top + 24, title, colour, 14, weight=600))
        parts += [
            _text(left + wide / 2, top + 24 + 19 * (k + 1), line, MUTED, 12.5) for k, line in enumerate(lines)
        ]
    parts += [_arrow(226, 106, 282, 72), _arrow(226, 130, 282, 164)]
    parts += [_line(516, 69, 560, 104, INK, 1.6), _line(516, 167, 560, 132, INK, 1.6)]
    parts.append(f'<circle cx="573" cy="118" r="16" fill="{CARD}" stroke="{INK}" stroke-width="1.6"/>')
    parts += [_text(573, 124, "+", INK, 18, weight=600), _arrow(589, 118, 626, 118)]
    parts.append(
        f'<path d="M743 170 V226 H119 V172" fill="none" stroke="{INK}" stroke-width="1.6" marker-end="url(#head)"/>'
    )
    parts.append(
        _text(440, 220, "open loop: each step from the one before, only the grips are given", MUTED, 12.5)
    )
    return _card(width, height, parts)


# pieces


class _Area:
    """A drawing area with its scales."""

    def __init__(
        self,
        box: tuple[float, float, float, float],
        x_range: tuple[float, float],
        y_range: tuple[float, float],
    ) -> None:
        self.left, self.top, self.right, self.bottom = box
        self._x, self._y = x_range, y_range

    def x(self, value: float) -> float:
        """Place across."""
        return self.left + (value - self._x[0]) / (self._x[1] - self._x[0]) * (self.right - self.left)

    def y(self, value: float) -> float:
        """Place down."""
        return self.bottom - (value - self._y[0]) / (self._y[1] - self._y[0]) * (self.bottom - self.top)

    def axes(
        self,
        across: Sequence[tuple[float, str]],
        down: Sequence[tuple[float, str]],
        x_label: str,
        y_label: str,
    ) -> list[str]:
        """Lines, numbers and labels."""
        parts = []
        for value, text in down:
            parts.append(_line(self.left, self.y(value), self.right, self.y(value), EDGE, 1))
            parts.append(_text(self.left - 8, self.y(value) + 4, text, MUTED, 12, anchor="end"))
        for value, text in across:
            parts.append(_line(self.x(value), self.bottom, self.x(value), self.bottom + 5, MUTED, 1))
            parts.append(_text(self.x(value), self.bottom + 19, text, MUTED, 12))
        parts.append(_line(self.left, self.bottom, self.right, self.bottom, MUTED, 1))
        parts.append(_text(0.5 * (self.left + self.right), self.bottom + 40, x_label, INK, 12.5))
        middle = 0.5 * (self.top + self.bottom)
        parts.append(
            f'<text x="22" y="{middle:.1f}" font-size="12.5" fill="{INK}" text-anchor="middle" '
            f'transform="rotate(-90 22 {middle:.1f})">{y_label}</text>'
        )
        return parts


def _card(width: int, height: int, parts: Sequence[str]) -> str:
    """The whole picture on its card."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="{FONT}">'
    )
    marker = (
        '<defs><marker id="head" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0 0 L10 5 L0 10 z" fill="{INK}"/></marker></defs>'
    )
    card = f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" rx="10" fill="{CARD}" stroke="{EDGE}"/>'
    return "\n".join([head, marker, card, *parts, "</svg>"]) + "\n"


def _box(left: float, top: float, wide: float, high: float, colour: str = EDGE) -> str:
    return (
        f'<rect x="{left}" y="{top}" width="{wide}" height="{high}" rx="8" fill="#ffffff" stroke="{colour}" '
        'stroke-width="1.4"/>'
    )


def _text(
    x: float,
    y: float,
    text: str,
    colour: str = INK,
    size: float = 14,
    anchor: str = "middle",
    weight: int = 400,
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{colour}" text-anchor="{anchor}" '
        f'font-weight="{weight}">{text}</text>'
    )


def _line(
    x1: float, y1: float, x2: float, y2: float, colour: str, width: float, dash: str | None = None
) -> str:
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" '
        f'stroke-width="{width:g}"{dashed}/>'
    )


def _arrow(x1: float, y1: float, x2: float, y2: float, colour: str = INK) -> str:
    return _line(x1, y1, x2, y2, colour, 1.6).replace("/>", ' marker-end="url(#head)"/>')


def _polyline(points: Sequence[tuple[float, float]], colour: str, width: float, opacity: float = 1.0) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width:g}" opacity="{opacity:g}"/>'


def _dots(points: Array | Sequence[Sequence[float]], colour: str, radius: float) -> str:
    return "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{colour}"/>' for x, y in points)


def _bent(middle: float, droop: float, rows: int = 3, columns: int = 8) -> Array:
    """Points of a beam that sinks towards its free end, (rows * columns, 2)."""
    along, across = np.meshgrid(np.linspace(0, 1, columns), np.linspace(-11, 11, rows), indexing="ij")
    down = 90 + droop * along**2
    turn = np.arctan(2 * droop * along / 130)
    return np.stack(
        [middle - 66 + 130 * along - across * np.sin(turn), down + across * np.cos(turn)], axis=-1
    ).reshape(-1, 2)


def _lattice(middle: float) -> list[str]:
    """The cells under the beam."""
    grid = _bent(middle, 44.0, 4, 11).reshape(11, 4, 2)
    columns = [_polyline(line.tolist(), TWIN, 1.2) for line in grid]
    return columns + [_polyline(line.tolist(), TWIN, 1.2) for line in grid.transpose(1, 0, 2)]


def _grip(middle: float) -> str:
    return f'<rect x="{middle - 78}" y="74" width="14" height="34" rx="3" fill="{GRIP}"/>'


def _frames(left: float, top: float, wide: float, share: float, told: str) -> str:
    """The frames of a recording, those for training and those that are held out."""
    first = wide * share
    return (
        f'<rect x="{left}" y="{top}" width="{first:.1f}" height="22" rx="4" fill="#e3e7ee"/>'
        f'<rect x="{left + first + 3:.1f}" y="{top}" width="{wide - first - 3:.1f}" height="22" rx="4" fill="#d6ebdd"/>'
        + _text(left + first / 2, top + 15, told, INK, 12)
        + _text(left + first + (wide - first) / 2, top + 15, "held-out frames give the errors", INK, 12)
    )


def _power(value: float) -> str:
    exponent = round(math.log10(value))
    return f'10<tspan dy="-5" font-size="9">{exponent}</tspan>'


if __name__ == "__main__":
    main()
