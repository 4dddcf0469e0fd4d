"""``python -m benchmarks.trace.hidden_effects --json FILE``: trace what other engines recorded of bodies with a secret.

Beams, a soft blob held at its end and a slab that hangs by two corners are recorded by finite elements
(:mod:`benchmarks.peers.finite_elements`), ropes by PyElastica's Cosserat rods (:mod:`benchmarks.peers.elastica_ropes`,
of the extra ``bench``), cloths by MuJoCo's triangles (:mod:`benchmarks.peers.flex_cloths`), blocks that are drawn over
a table by its tetrahedra and contacts (:mod:`benchmarks.peers.flex_blocks`); all undamped, with noise and points that
go out of sight. What acts is drawn by a seed, one or two effects, none, one that no library has (a gust of a tenth of a
second), or a camera whose clock is off. The trace sees scene and recording only, as one of ``benchmarks.trace.folder``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from benchmarks.harness import Report, write_section
from benchmarks.peers.finite_elements import Acting, Floats
from benchmarks.trace.folder import CLAIMS, PRIMARY, score, traced
from benchmarks.trace.hidden_bodies import OBJECTS, Hand, Recorder
from benchmarks.trace.hidden_cases import SETS, TITLES, Case
from benchmarks.trace.hidden_kratos import KRATOS
from benchmarks.trace.hidden_opensees import OPENSEES
from benchmarks.trace.hidden_solids import SOLIDS, NotConvergedError
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld_scenes.bundle import write_bundle

FPS, FRAMES, TRAIN_SHARE, SIGMA_M = 30.0, 60, 0.7, 1e-3
UNSEEN = 0.05
CLEAR = 4.0  # displacement by the effect over the noise, on the test frames
GRAVITY = np.array([0.0, 0.0, -9.81])
_FINE = 4  # frames between two of the camera's, for one whose clock is off


def _acting(acts: dict[str, dict[str, Any]]) -> Acting:
    found = Acting(gravity_m_s2=GRAVITY)
    for name, law in acts.items():
        if name == "linear_drag":
            found = replace(found, linear_drag_per_s=law["c"])
        elif name == "quadratic_drag":
            found = replace(found, quadratic_drag_per_m=law["k"])
        elif name == "internal_viscosity":
            found = replace(found, viscosity_pa_s=law["eta"])
        elif name == "gravity_tilt":
            axis = np.array(law["axis"]) / np.linalg.norm(law["axis"])
            found = replace(
                found, gravity_m_s2=Rotation.from_rotvec(np.radians(law["degrees"]) * axis).apply(GRAVITY)
            )
        elif name == "fibre":
            found = replace(found, fibre_pa=law["modulus"], fibre_axis=np.array(law["axis"]))
        elif name == "tether":
            found = replace(found, tether_n_m=law["k"], tether_rest_m=law["rest_length"], tether_radius_m=law["radius"],
                            anchor=np.array(law["anchor"]), attach=np.array(law["attach"]))  # fmt: skip
        elif name == "gust":
            found = replace(found, push=partial(_gust, law))
    return found


def _gust(law: dict[str, float], time: float) -> Floats:
    return np.array([0.0, law["m_s2"] if law["from_s"] <= time < law["to_s"] else 0.0, 0.0])


def recording(case: Case) -> tuple[Scene, dict[str, Any]]:
    """What a camera saw, and the truth: what acts and how much it shows on the test frames, over the noise."""
    known = (OBJECTS | KRATOS | SOLIDS | OPENSEES)[case.object]
    rng = np.random.default_rng(900 + case.seed)
    recorder = known.recorder(case.seed, rng)
    times = np.arange(getattr(known, "frames", FRAMES)) / FPS
    clean = recorder.tracks(_acting(case.acts), case.acts.get("control_lag", {}).get("seconds", 0.0), times)
    if "clock" in case.acts:  # the camera's frames are later than it says
        fine = np.arange(_FINE * (FRAMES + 1)) / (_FINE * FPS)
        seen_at = times + case.acts["clock"]["offset_s"]
        clean = CubicSpline(fine, recorder.tracks(Acting(gravity_m_s2=GRAVITY), 0.0, fine))(seen_at)
    shown = _shown(case, recorder, clean, times)
    strength = "none" if not case.acts else "clear" if shown >= CLEAR else "weak"
    scene = before_a_camera(case.name, known, recorder, clean, rng)
    return scene, {"parameters": case.acts, "strength": strength, "signature_sigmas_test": shown}


def _shown(case: Case, recorder: Recorder, clean: Floats, times: Floats) -> float:
    """Displacement by what acts on the test frames, root mean square per axis over the noise."""
    if not case.acts:
        return 0.0
    record, with_it = recorder.tracks, clean
    if recorder.rough is not None:
        record = recorder.rough
        with_it = record(_acting(case.acts), case.acts.get("control_lag", {}).get("seconds", 0.0), times)
    by_it = with_it - record(Acting(gravity_m_s2=GRAVITY), 0.0, times)
    return float(np.sqrt(np.mean(by_it[round(TRAIN_SHARE * len(times)) :] ** 2)) / SIGMA_M)


def before_a_camera(
    name: str, known: Any, recorder: Recorder, clean: Floats, rng: np.random.Generator
) -> Scene:
    """The scene that a camera with noise sees, which loses a point now and then.

    Args:
        name: of the scene.
        known: the body: what it declares.
        recorder: its hands, and the points that fill it.
        clean: points without noise (T, N, 3) [m], ``FPS`` frames a second.
        rng: of the noise.
    """
    times, begun = np.arange(len(clean)) / FPS, round(TRAIN_SHARE * len(clean))
    visible = rng.uniform(size=clean.shape[:2]) > UNSEEN
    visible[0] = True
    points = clean + rng.normal(0.0, SIGMA_M, clean.shape)
    controllers, velocities, grips, first = [], [], [], 0
    for hand in recorder.hands:
        box = hand.box
        handle = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
        moved = partial(_moved, hand, handle)
        controllers.append(np.stack([moved(t) for t in times]))
        velocities.append(np.stack([(moved(t + 1e-5) - moved(t - 1e-5)) / 2e-5 for t in times]))
        seen = np.all((clean[0] >= box[0] - 1e-9) & (clean[0] <= box[1] + 1e-9), axis=1)
        grips.append(
            Grip(tuple(range(first, first + 8)), box[0], box[1], tuple(np.flatnonzero(seen).tolist()))
        )
        first += 8
    return Scene(
        name=name, kind=known.kind, description=f"a {known.kind} recorded by another engine", points=points,
        visible=visible, controllers=np.concatenate(controllers, axis=1),
        controller_velocities=np.concatenate(velocities, axis=1), times=times, rest_volume_points=recorder.inside(rng),
        gravity_m_s2=GRAVITY, noise_sigma_m=SIGMA_M, train=(0, begun), test=(begun, len(clean)),
        initial_state=UNDEFORMED_AT_REST, fps=FPS, grips=tuple(grips), declared={}, body=known.body,
        ground=getattr(known, "ground", None),
    )  # fmt: skip


def _moved(hand: Hand, handle: Floats, time: float) -> Floats:
    """Corners of a grip's box, (8, 3) [m]."""
    turn, shift = hand.motion.place(0.0, time)
    return (handle - hand.centre) @ turn.T + hand.centre + shift


def _made(case: Case, folder: Path) -> Path:
    """The scene's folder with its truth; made if it is not there."""
    scene = folder / case.name
    if not (scene / "truth.json").exists():
        found, truth = recording(case)
        write_bundle(found, scene)
        (scene / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")
    return scene


def scored(case: Case, scene: Path, report: dict[str, Any]) -> dict[str, Any]:
    """What the answer is worth: as ``benchmarks.trace.folder`` scores it, and beside effects of the library by its
    verdict."""
    truth = json.loads((scene / "truth.json").read_text())
    library = all(name in PRIMARY for name in truth["parameters"])
    row = score(report, truth if library else {**truth, "parameters": {}})
    if not library:
        names = {*row["named"], *row["equivalent"]}
        clock = "clock" in case.acts and "measurement_clock" in names
        row["right"] = row["verdict"] in case.answers and (clock or not names)
        row["wrong_name"] = bool(row["verdict"] in CLAIMS and not clock)
    row["truth"] = " + ".join(case.acts) or "none"
    row["object"], row["shown"] = case.object, truth["signature_sigmas_test"]
    return row


def page(rows: list[dict[str, Any]], name: str = "hidden_effects") -> Report:
    """The table of the rows that there are, of one of the ``SETS``."""
    header = ("scene", "object", "acts", "shows", "verdict", "named (or)", "right", "strength", "misfit", "before",
              "after", "removed", "seconds")  # fmt: skip
    table = []
    for row in rows:
        names = " + ".join(row["named"]) + (f" ({', '.join(row['equivalent'])})" if row["equivalent"] else "")
        table.append(
            (row["scene"], row["object"], row["truth"], f"{row['shown']:.1f}", row["verdict"], names or "-",
             "yes" if row["right"] else "no", ", ".join(f"{r:.2f}" for r in row["strength_ratio"].values()) or "-",
             f"{row['misfit_before']:.2f} to {row['misfit_after']:.2f}", f"{row['before_mm']:.2f}",
             f"{row['after_mm']:.2f}", "-" if row["removed"] is None else f"{row['removed']:.0%}",
             f"{row['seconds']:.0f}")
        )  # fmt: skip
    acting = [row for row in rows if row["truth"] != "none"]
    silent = [row for row in rows if row["truth"] == "none"]
    ratios = [r for row in acting if row["right"] for r in row["strength_ratio"].values()]
    missing = sorted({case.name for case in SETS[name]()} - {row["scene"] for row in rows})
    notes = (
        f"{sum(row['right'] for row in acting)} of {len(acting)} with something in them right, "
        f"{sum(row['verdict'] in CLAIMS for row in silent)} of {len(silent)} without falsely named, "
        f"{sum(row['wrong_name'] for row in rows)} wrong names; {sum(abs(r - 1) <= 0.25 for r in ratios)} of "
        f"{len(ratios)} strengths of right answers within 25 %.",
        "Shows: displacement by the effect on the test frames, root mean square per axis, over the noise of 1 mm; "
        "errors in mm; strength is found over true.",
        f"Not traced: {', '.join(missing) or 'none'}.",
    )
    return Report(
        name=name,
        title=TITLES[name],
        figures={"scenes": rows},
        header=header,
        rows=tuple(table),
        notes=notes,
        seed=0,
    )


def main() -> int:
    """Record, trace and score; 0 where every scene gave an answer."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.hidden_effects", description=__doc__)
    parser.add_argument(
        "--json", type=Path, required=True, help="figures; rows of scenes not asked for stay in it"
    )
    parser.add_argument("--set", choices=sorted(SETS), default="hidden_effects", help="which recordings")
    parser.add_argument("--scenes", type=Path, default=None, help="folder that keeps the recordings")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes; none given: all")
    parser.add_argument("--resume", type=Path, default=None, help="folder that remembers simulations")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--time-limit", type=float, default=None, help="minutes; as the command has it if left out"
    )
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    given = parser.parse_args()
    rows = (
        {row["scene"]: row for row in json.loads(given.json.read_text())["scenes"]}
        if given.json.exists()
        else {}
    )
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        for case in SETS[given.set]():
            if given.only and case.name not in given.only:
                continue
            try:
                scene = _made(case, given.scenes or Path(folder, "made"))
            except NotConvergedError as refused:
                print(f"{case.name} is refused: {refused}", file=sys.stderr, flush=True)
                failed = True
                continue
            report = traced(scene, Path(folder), given.resume, given.processes, given.time_limit)
            failed |= report is None
            if report is not None:
                rows[case.name] = scored(case, scene, report)
                print(json.dumps(rows[case.name]), flush=True)
            given.json.write_text(
                json.dumps({"scenes": [rows[name] for name in sorted(rows)]}, indent=2) + "\n"
            )
    if given.docs is not None:
        write_section(page([rows[name] for name in sorted(rows)], given.set), given.docs)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
