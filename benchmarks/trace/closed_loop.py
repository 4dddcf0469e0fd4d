"""``python -m benchmarks.trace.closed_loop --set DIR --real DIR --json FILE``: the loop closed through the service.

An embedded service with its broker, workers and trainer is started; a scene is uploaded, and one pipeline fits the
declared physics, traces what it leaves, and trains a world model on the twin without and on the twin with what the
trace added. The card of the second model gives the held-out errors before and after of twin and world model. Recordings
of the same object that nothing has seen are then held against both versions by assessments.

Three scenes: a rope recorded by another engine whose gravity is tilted without a word of it, a measured beam of
silicone, and a measured cable. The beam's noise is what its repeat says (``benchmarks.trace.real``); measured frames
are thinned as there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from physworld_client.cli.service import Embedded
from physworld_client.client import Client

from benchmarks.harness import Report, write_section
from benchmarks.trace.real import CASES, SHARED, read, repeatability
from physworld_scenes.bundle import write_bundle
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate

UNDECLARED = SHARED.parents[0] / "undeclared"
EPISODES, STEPS, PARTICLES = 40, 600, 1000
_BEAM = next(case for case in CASES if case.name == "beam, noise of the repeat")
_CABLE = next(case for case in CASES if case.name == "rope, shaken up and down")


@dataclass(frozen=True)
class Loop:
    """A scene to close the loop on, and recordings of the same object for assessments."""

    name: str
    scene: Path
    unseen: tuple[Path, ...] = ()


def loops(undeclared: Path, real: Path, folder: Path) -> list[Loop]:
    """The scenes, without their truth, as bundles below ``folder``."""
    blind = folder / "d10"
    blind.mkdir()
    for name in ("scene.json", "scene.npz"):
        shutil.copy(undeclared / "d10" / name, blind / name)
    assert _BEAM.repeats is not None
    sigma = repeatability(*(read(name, _BEAM, real) for name in _BEAM.repeats))
    bundles = []
    for name in (*_BEAM.fitted, *_BEAM.held_out):
        bundles.append(folder / name)
        write_bundle(replace(read(name, _BEAM, real), noise_sigma_m=sigma), bundles[-1])
    cable = folder / _CABLE.fitted[0]
    write_bundle(read(_CABLE.fitted[0], _CABLE, real), cable)
    return [
        Loop("rope of another engine", blind),
        Loop("silicone beam", bundles[0], tuple(bundles[1:])),
        Loop("cable", cable),
    ]


def close(client: Client, loop: Loop, episodes: int, steps: int, seed: int) -> dict[str, Any]:
    """One pipeline with its assessments: what the card and they say."""
    begun = time.perf_counter()
    name = loop.scene.name
    scene = client.scenes.create(loop.scene)
    body = PipelineCreate(
        scene_id=scene.id,
        model_name=name,
        close_the_loop=True,
        fit=FitConfig(damping="none", particle_budget=PARTICLES),
        dataset=DatasetConfig(episodes=episodes, seed=seed),
        training=TrainingConfig(steps=steps, seed=seed),
    )
    client.jobs.wait(client.pipelines.create(body), on_progress=_say)
    version = client.models.version(name)
    card = version.metrics["closed_loop"]
    versions = {"after": version.version}
    if card.get("baseline_version"):
        versions["before"] = card["baseline_version"]
    unseen = []
    for path in loop.unseen:
        recording = client.scenes.create(path).id
        row: dict[str, Any] = {"scene": path.name}
        for when, number in versions.items():
            job = client.assessments.create(name, recording, number, open_trace=False)
            client.jobs.wait(job)
            found = client.assessments.get(job.outputs[0].id)
            row[when] = found.model_dump(mode="json", include=_KEPT)
        unseen.append(row)
    return {"name": loop.name, "scene": name, "closed_loop": card, "unseen": unseen,
            "held_out": version.metrics["held_out"], "seconds": time.perf_counter() - begun}  # fmt: skip


_KEPT = {"outcome", "measured", "expected", "twin_m", "baselines_m"}


def _say(job: Any) -> None:
    print(f"{job.kind} {job.state} {job.progress.done}/{job.progress.total}", file=sys.stderr)


def page(rows: list[dict[str, Any]], episodes: int, steps: int) -> Report:
    """Three lines a scene, and two for every recording that nothing has seen."""
    table, notes = [], []
    for row in rows:
        card = row["closed_loop"]
        floor = _mm(card["noise_floor_m"])
        notes.append(f"{row['name']} ({row['scene']}), {row['seconds']:.0f} s: {card['statement']}")
        for kind, label in (("twin", "twin"), ("world_model", "world model")):
            found = card.get(kind, {})
            table.append(
                [row["name"] if kind == "twin" else "", f"{row['scene']} (its last part)", label,
                 _mm(found.get("before_m")), _mm(found.get("recalibrated_m")), _mm(found.get("after_m")),
                 _range(found.get("gain_ci95_m")), floor]
            )  # fmt: skip
        for unseen in row["unseen"]:
            before, after = unseen.get("before"), unseen["after"]
            for key, label in (("twin_m", "twin"), ("measured", "world model")):
                table.append(
                    ["", f"{unseen['scene']} (not used)", label, _mm(_error(before, key)), "-",
                     _mm(_error(after, key)), "-", floor]
                )  # fmt: skip
    return Report(
        name="closed_loop",
        title="Closed through the service",
        figures={"loops": rows},
        header=["object", "measured on", "what", "declared physics", "calibrated anew without the effect",
                "with the effect", "gain, 95 %", "noise"],
        rows=table,
        notes=[
            f"Mean track errors in mm, open loop, on frames or recordings that no step has seen; {episodes} episodes, "
            f"{steps} training steps. `calibrated anew`: the declared physics as the trace calibrates it.",
            *notes,
        ],
    )  # fmt: skip


def _error(found: dict[str, Any] | None, key: str) -> float | None:
    if found is None:
        return None
    value = found[key]
    return value["error_m"] if isinstance(value, dict) else value


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.3g}"


def _range(values: list[float | None] | None) -> str:
    if not values or None in values:
        return "-"
    return f"{_mm(values[0])} to {_mm(values[1])}"


def main() -> int:
    """Run what is missing from the JSON, write after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.closed_loop", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="all figures; loops in it are not run again")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--set", type=Path, default=UNDECLARED, help="folder of the undeclared scenes")
    parser.add_argument("--real", type=Path, default=SHARED, help="folder of the measured recordings")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes; none: all")
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for folder in (given.set / "d10", given.real / "beam_free_a"):
        if not (folder / "scene.json").exists():
            print(f"no recording in {folder}", file=sys.stderr)
            return 1
    done = (
        {row["scene"]: row for row in json.loads(given.json.read_text())["loops"]}
        if given.json.exists()
        else {}
    )
    with tempfile.TemporaryDirectory() as folder:
        every = loops(given.set, given.real, Path(folder))
        missing = [
            loop for loop in every
            if loop.scene.name not in done and (not given.only or loop.scene.name in given.only)
        ]  # fmt: skip
        if missing:
            service = Embedded(Path(folder) / "data", given.workers, stays=False)
            try:
                address = service.wait_until_ready()
                with Client(address.url, address.token) as client:
                    for loop in missing:
                        row = close(client, loop, given.episodes, given.steps, given.seed)
                        done[loop.scene.name] = row
                        given.json.write_text(json.dumps({"loops": list(done.values())}, indent=2) + "\n")
                        print(json.dumps(row), flush=True)
            finally:
                service.stop()
        rows = [done[loop.scene.name] for loop in every if loop.scene.name in done]
    if given.docs is not None:
        write_section(page(rows, given.episodes, given.steps), given.docs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
