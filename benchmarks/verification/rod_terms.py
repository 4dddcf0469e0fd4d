"""``python -m benchmarks.verification.rod_terms --json FILE``: what each term of a discrete rod brings.

Every measured rope, branched cable and foam rod is fitted with all terms and with each left out, on two splits: the
recording's own, and its first half for training with the next three tenths held out. A term that brings nothing on any
measured object has no place in the law.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import describe_machine
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.evaluate.metrics import track_error
from physworld.scene import Scene
from physworld_scenes.bundle import read_bundle

TERMS: dict[str, tuple[str, ...]] = {
    "all terms": (),
    "no natural curvature": ("curvature_",),
    "one natural curvature": tuple(f"curvature_{mode}_" for mode in range(1, 8)),
    "no natural twist": ("natural_twist",),
    "torsion of a round section": ("torsion_ratio",),
    "no stretch": ("stretching_n",),
    "no friction of bending": ("friction_",),
    "no creep": ("creep_",),
    "no quadratic drag": ("drag_normal_per_m",),
}
KINDS = ("rope", "branched_rope", "rod")
HALF, NEXT = 0.5, 0.8


def splits(scene: Scene) -> dict[str, Scene]:
    """The recording under its own split, and with its first half for training."""
    half, end = (round(share * scene.frame_count) for share in (HALF, NEXT))
    return {"own": scene, "first half": replace(scene, train=(0, half), test=(half, end))}


def errors(scene: Scene, held: tuple[str, ...]) -> dict[str, float]:
    """Track errors [m] of a fit on training and held-out frames."""
    fitted = calibrate(scene, CalibrationConfig(held=held))
    found = {}
    for name, (first, last) in (("train", (1, scene.train[1])), ("test", scene.test)):
        window = slice(max(first, 1), last)
        found[name] = float(track_error(fitted.tracks[window], scene.points[window], scene.visible[window]))
    return found


def main() -> int:
    """Fit, write what is done after every fit, print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verification.rod_terms", description=__doc__)
    parser.add_argument("--set", type=Path, default=Path("../shared/data/real"), help="folder of scenes")
    parser.add_argument("--json", type=Path, required=True, help="figures; fits in it are not done again")
    parser.add_argument("--only", nargs="*", default=None, help="names of scenes")
    given = parser.parse_args()
    found: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {"scenes": {}}
    found["machine"] = describe_machine()
    for folder in sorted(given.set.iterdir()) if given.set.is_dir() else []:
        if not (folder / "scene.json").is_file() or (given.only and folder.name not in given.only):
            continue
        scene = read_bundle(folder)
        if scene.kind not in KINDS:
            continue
        rows = found["scenes"].setdefault(scene.name, {})
        for split, cut in splits(scene).items():
            for term, held in TERMS.items():
                if term not in rows.setdefault(split, {}):
                    rows[split][term] = errors(cut, held)
                    print(f"{scene.name}, {split}, {term}: {rows[split][term]}", file=sys.stderr, flush=True)
                    given.json.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found["scenes"]))
    return 0


def table(scenes: dict[str, Any]) -> str:
    """Held-out errors [mm] as Markdown: a row a term, the own split and the first half in every cell."""
    names = list(scenes)
    lines = ["| | " + " | ".join(names) + " | median |", "|---" * (len(names) + 2) + "|"]
    for term in TERMS:
        cells, ratios = [], []
        for name in names:
            pair = [scenes[name][split].get(term, {}).get("test") for split in ("own", "first half")]
            cells.append(" / ".join("-" if e is None else f"{1e3 * e:.1f}" for e in pair))
            whole = [scenes[name][split].get("all terms", {}).get("test") for split in ("own", "first half")]
            ratios += [e / w for e, w in zip(pair, whole, strict=True) if e is not None and w is not None]
        median = f"{np.median(ratios):.2f}" if ratios else "-"
        lines.append(f"| {term} | " + " | ".join(cells) + f" | {median} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
