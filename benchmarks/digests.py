"""``python -m benchmarks.digests --json FILE [--check FILE]``: digests of what a refactoring must not change.

A beam, a rope and a sheet, each recorded by the project's engine with a linear drag that their scenes do not declare,
go through the library (``physworld fit``, ``physworld trace``) and through the service (upload, fit, demonstrations,
training, published model, trace). What comes out is reduced to SHA-256 digests: of every array, and of every report
without what differs from run to run (times, ids, dates). The same code on the same machine gives the same digests;
another processor need not. ``--check`` compares with those of an earlier run, names what differs, and ends with 1.

Only the command line and the SDK are used, so that this script stays as it is while the rooms behind them move.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from physworld_client.cli.service import Embedded
from physworld_client.client import Client
from safetensors.numpy import load_file

from benchmarks.harness import describe_machine
from benchmarks.trace.power_objects import OBJECTS, observed, recorded
from physworld.effects.registry import effect
from physworld_scenes.bundle import write_bundle
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig

BODIES = ("beam", "rope", "sheet")
DRAG_PER_S = 3.0
PARTICLES = {"beam": 250, "rope": 60, "sheet": 60}
EPISODES, STEPS, VERTICES, SIMULATIONS = 6, 40, 24, 60
SEED = 1
VOLATILE = frozenset({
    "artifacts", "cpu_s", "created_at", "dataset_id", "date", "fit_id", "id", "job_id", "lineage", "machine",
    "scene_id", "seconds", "sha256", "source", "speed", "stages", "steps_per_second", "store_seconds",
    "trace_id", "versions", "wall_s",
})  # fmt: skip
"""Keys of reports that name a run and not its result, or hold times."""


def made(folder: Path) -> dict[str, Path]:
    """The recordings as bundles below ``folder``."""
    bundles = {}
    for name in BODIES:
        known = OBJECTS[name](SEED)
        acting = known.truth.with_effect(effect("air_drag_linear", rate_per_s=DRAG_PER_S))
        scene = recorded(known.scene, observed(acting, known.scene), SEED)
        bundles[name] = folder / f"digest_{name}"
        # A bundle's grip must hold tracked points, and the sheet's holds none: only its controllers are declared.
        grips = () if name == "sheet" else scene.grips
        write_bundle(replace(scene, name=f"digest_{name}", grips=grips), bundles[name])
    return bundles


def of_library(bundle: Path, particles: int, folder: Path) -> dict[str, str]:
    """Digests of a fit and of a trace by the command line."""
    fit, trace, tracks = folder / "fit.json", folder / "trace.json", folder / "tracks.npz"
    size = ["--particles", str(particles)]
    run("fit", bundle, *size, "--simulations", str(SIMULATIONS), "--json", fit, "--out", folder / "fit")
    run("trace", bundle, *size, "--time-limit", "0", "--out", trace, "--predictions", tracks)
    found = {"fit report": of_json(json.loads(fit.read_text()))}
    for path in sorted((folder / "fit").glob("*.npz")):
        found |= {f"fit {path.stem} {name}": digest for name, digest in of_arrays(path)}
    found["trace report"] = of_json(json.loads(trace.read_text()))
    return found | {f"trace {name}": digest for name, digest in of_arrays(tracks)}


def of_service(client: Client, bundle: Path, particles: int, folder: Path) -> dict[str, str]:
    """Digests of one pipeline's fit, episodes and model, and of a trace."""
    scene = client.scenes.create(bundle)
    body = PipelineCreate(
        scene_id=scene.id,
        model_name=bundle.name,
        fit=FitConfig(particle_budget=particles, max_simulations=SIMULATIONS),
        dataset=DatasetConfig(episodes=EPISODES, seed=SEED),
        training=TrainingConfig(
            hidden=64, message_passing_steps=7, steps=STEPS, vertices=VERTICES, fine_tune_steps=8, seed=SEED
        ),
    )
    client.jobs.wait(client.pipelines.create(body))
    version = client.models.version(bundle.name)
    found = {"scene": scene.digest, "model metrics": of_json(version.metrics)}
    fit = client.fits.get(str(version.fit_id))
    found["fit parameters"] = of_json({n: p.model_dump(mode="json") for n, p in fit.parameters.items()})
    dataset_id = str(version.dataset_id)
    client.datasets.export(dataset_id, folder / "episodes", format="npz")
    for path in sorted((folder / "episodes").rglob("*.npz")):
        found |= {f"{path.stem} {name}": digest for name, digest in of_arrays(path)}
    model = folder / "model"
    client.models.download(bundle.name, model)
    found["model step.onnx"] = of_program(onnx.load(model / "step.onnx"))
    found |= {
        f"model {name}": of_array(array) for name, array in load_file(model / "model.safetensors").items()
    }
    found |= {f"model prediction {name}": digest for name, digest in of_arrays(model / "prediction.npz")}
    job = client.jobs.wait(
        client.traces.create(scene.id, TraceConfig(), fit=FitConfig(particle_budget=particles))
    )
    trace = client.traces.get(job.outputs[0].id)
    found["trace report"] = of_json(trace.model_dump(mode="json"))
    tracks = client.traces.tracks(trace.id)
    return found | {f"trace {name}": of_array(tracks[name]) for name in sorted(tracks)}


def of_arrays(path: Path) -> Iterator[tuple[str, str]]:
    """Name and digest of every array in an npz: its type, shape and bytes."""
    with np.load(path, allow_pickle=False) as arrays:
        for name in sorted(arrays.files):
            text = name == "attributes"  # of an episode: JSON, in which the run's ids stand
            yield name, of_json(json.loads(str(arrays[name]))) if text else of_array(arrays[name])


def of_program(program: onnx.ModelProto) -> str:
    """Digest of an ONNX program's operations and weights, without the names that the exporter gave them."""
    weights = sorted(of_array(onnx.numpy_helper.to_array(tensor)) for tensor in program.graph.initializer)
    return of_json([weights, [node.op_type for node in program.graph.node]])


def of_array(array: np.ndarray) -> str:
    """Digest of an array's type, shape and bytes."""
    head = f"{array.dtype.str} {array.shape}\n".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def of_json(document: Any) -> str:
    """Digest of a report without the keys that differ from run to run."""
    return hashlib.sha256(json.dumps(_steady(document), sort_keys=True).encode()).hexdigest()


def _steady(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _steady(item) for key, item in value.items() if key not in VOLATILE}
    return [_steady(item) for item in value] if isinstance(value, list) else value


def run(*words: object) -> None:
    """One command of the command line; its output goes to stderr. Raises CalledProcessError."""
    program = Path(sys.executable).with_name("physworld")
    command = [program, *(str(word) for word in words)]
    subprocess.run(command, check=True, stdout=sys.stderr)


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What of ``before`` is missing or another in ``after``, and what is new in it."""
    return [
        f"{way} {body}: {name}: {known.get(name)} before, {now.get(name)} after"
        for way in after
        for body, now in after[way].items()
        for known in [before[way].get(body, {})]
        for name in sorted({*known, *now})
        if known.get(name) != now.get(name)
    ]


def main() -> int:
    """Make the recordings, send them both ways, write or compare the digests."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.digests", description=__doc__)
    parser.add_argument("--json", type=Path, default=None, help="write the digests to this file")
    parser.add_argument("--check", type=Path, default=None, help="compare with the digests in this file")
    parser.add_argument("--only", nargs="*", choices=BODIES, default=BODIES)
    given = parser.parse_args()
    found: dict[str, Any] = {"library": {}, "service": {}}
    with tempfile.TemporaryDirectory(prefix="physworld-digests-") as place:
        folder = Path(place)
        bundles = made(folder)
        for name in given.only:
            found["library"][name] = of_library(bundles[name], PARTICLES[name], folder / "library" / name)
        service = Embedded(folder / "data", 2, stays=False)
        try:
            address = service.wait_until_ready()
            with Client(address.url, address.token) as client:
                for name in given.only:
                    out = folder / "service" / name
                    found["service"][name] = of_service(client, bundles[name], PARTICLES[name], out)
        finally:
            service.stop()
    count = sum(len(digests) for way in found.values() for digests in way.values())
    print(f"{count} digests of {', '.join(given.only)}")
    if given.json is not None:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps({**found, "machine": describe_machine()}, indent=2) + "\n")
    if given.check is None:
        return 0
    changed = differences(json.loads(given.check.read_text()), found)
    print("\n".join(changed) or f"the same as in {given.check}")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
