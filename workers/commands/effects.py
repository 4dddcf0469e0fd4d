"""``python -m physworld_workers.commands.effects [SCENE] [--json]``: the registry of effects, with strengths, units and
bounds.

Bounds follow the body. Without a scene they are those of three bodies of everyday size, a beam, a sheet and a rope;
with one they are those of the twin that the scene gives before calibration.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene

if TYPE_CHECKING:
    from physworld.effects.base import Effect
    from physworld.twin.twin import Twin

SCHEMA_VERSION = 1
_PARTICLES = 300  # bounds do not depend on the resolution, except for a grip's and a clamp's, by the cell
_WIDTH_ELSEWHERE = 160


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, list."""
    parser = argparse.ArgumentParser(prog="physworld effects list", description="The registry of effects.")
    parser.add_argument("scene", type=Path, nargs="?", help="folder, archive, final_data.pkl or C3D file")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _list(given))


def _list(given: argparse.Namespace) -> None:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # before the first import that starts it
    from physworld.twin.build import build_twin
    from physworld_workers.commands.terminal import read_scene

    scenes = everyday_scenes() if given.scene is None else {"scene": read_scene(given.scene)}
    document = effects_document({name: build_twin(scene, _PARTICLES) for name, scene in scenes.items()})
    if given.json:
        print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))
    else:
        _print(document)


def effects_document(twins: dict[str, Twin]) -> dict[str, Any]:
    """Every effect of the registry with what it offers, or why it is refused, on each twin."""
    from physworld.effects.registry import EFFECTS

    return {
        "schema_version": SCHEMA_VERSION,
        "effects": [
            {
                "name": kind.name,
                "kind": kind.kind,
                "title": kind.title,
                "equation": kind.equation,
                "bodies": {name: _offer(kind, twin) for name, twin in twins.items()},
            }
            for kind in EFFECTS.values()
        ],
    }


def everyday_scenes() -> dict[str, Scene]:
    """A beam of 30 cm, a cloth of 30 cm and a rope of 60 cm, each held at one end, 1 cm above the ground."""
    plate = np.array([[0.0, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, 0.0, 0.04]])
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 0.3, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    box = Body(box_min_m=np.zeros(3), box_max_m=np.array([0.3, 0.04, 0.04]))
    grip = Grip((0, 1, 2), np.zeros(3), np.array([0.03, 0.04, 0.04]))
    return {
        "solid": _still("beam", [[0.3, 0.02, 0.02]], plate, box, (grip,)),
        "sheet": _still("sheet", np.pad(grid, ((0, 0), (0, 1))), plate, Body(thickness_m=2e-3)),
        "rod": _still("rope", np.linspace([0, 0, 0], [0.6, 0, 0], 6), plate[:1], Body(radius_m=4e-3)),
    }


def _still(
    kind: str, points: Any, controllers: Array, body: Body, grips: tuple[Grip, ...] = ()
) -> Scene:  # fmt: skip
    points = np.repeat(np.asarray(points, dtype=float)[None], 3, axis=0)
    return Scene(
        name=f"everyday {kind}",
        kind=kind,
        points=points,
        visible=np.ones(points.shape[:2], dtype=bool),
        controllers=np.repeat(controllers[None], 3, axis=0),
        times=np.arange(3) / 30.0,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=None,
        train=(0, 2),
        test=(2, 3),
        initial_state=UNDEFORMED_AT_REST,
        body=body,
        ground=Ground(-0.01, 0.5),
        grips=grips,
    )


def _offer(kind: type[Effect], twin: Twin) -> dict[str, Any]:
    refused = kind.refuses(twin)
    strengths = kind.strengths(twin) if refused is None else ()
    return {
        "refused": refused,
        "strengths": [
            {
                key: value.item() if isinstance(value, np.generic) else value
                for key, value in asdict(s).items()
            }
            for s in strengths
        ],
    }


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDTH_ELSEWHERE)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("name", "kind", "strengths, bounds", "meaning"):
        table.add_column(heading, overflow="fold")
    for entry in document["effects"]:
        table.add_row(entry["name"], entry["kind"], _strengths(entry["bodies"]), _meaning(entry))
    console.print(table, markup=False)
    console.print(
        "Strengths in brackets shape an effect; the others switch it on, zero is off.", markup=False
    )


def _strengths(bodies: dict[str, dict[str, Any]]) -> str:
    """One strength a line with the bounds of the first body that has it."""
    lines: dict[str, str] = {}
    for offer in bodies.values():
        for s in offer["strengths"]:
            unit = "" if s["unit"] == "1" else f" {s['unit']}"
            text = f"{s['name']}  {s['low']:.3g} to {s['high']:.3g}{unit}"
            lines.setdefault(s["name"], text if s["gate"] else f"({text})")
    return "\n".join(lines.values())


def _meaning(entry: dict[str, Any]) -> str:
    refused = [
        f"not for {name}: {offer['refused']}" for name, offer in entry["bodies"].items() if offer["refused"]
    ]
    return "\n".join([entry["title"], entry["equation"], *refused])


if __name__ == "__main__":
    sys.exit(main())
