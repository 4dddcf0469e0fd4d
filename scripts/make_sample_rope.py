"""Makes the sample scene ``sample/hanging_rope`` with a chain of masses and springs, an engine that is not ours.

A rope of 0.6 m hangs from a gripper that holds its first 2 cm, is swayed, lifted and let swing for 3 s. Stretch and
bending springs act between 61 masses, each with a weak dashpot; semi-implicit Euler. 13 material points along it are
"tracked" at 30 frames per second with Gaussian noise.

    python scripts/make_sample_rope.py            writes sample/hanging_rope
    python scripts/make_sample_rope.py --check    prints the effect of half the time step
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld_scenes.bundle import checked, write_bundle

NAME = "hanging_rope"
TARGET = Path(__file__).resolve().parents[1] / "sample" / NAME
FRAMES, TRAIN_FRAMES, FPS = 90, 63, 30.0
GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Recipe:
    """Everything that the scene depends on. SI units."""

    masses: int = 61
    length_m: float = 0.6
    top_m: float = 1.0
    held: int = 3
    radius_m: float = 0.004
    density_kg_m: float = 0.05
    stretching_n: float = 40.0
    bending_n_m2: float = 2e-5
    stretch_dashpot_n_s: float = 0.01
    bend_dashpot_n_m2_s: float = 2e-7
    steps_per_frame: int = 600
    noise_sigma_m: float = 5e-4
    seed: int = 20251


def gripped(recipe: Recipe, t: float) -> np.ndarray:
    """Displacement of the gripper at time t [s], (3,) [m]; quintic ramps, so C2."""

    def ramp(begin: float, end: float) -> float:
        s = min(max((t - begin) / (end - begin), 0.0), 1.0)
        return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)

    x = 0.14 * ramp(0.1, 0.7) - 0.24 * ramp(0.9, 1.6) + 0.1 * ramp(2.0, 2.6)
    y = 0.1 * ramp(0.5, 1.1) - 0.16 * ramp(1.4, 2.2)
    z = 0.08 * ramp(0.3, 0.9) - 0.1 * ramp(1.7, 2.4)
    return np.array([x, y, z])


def simulate(recipe: Recipe, frames: int = FRAMES, drag_per_s: float = 0.0) -> np.ndarray:
    """Places of the masses at every frame, (frames, masses, 3) [m], perhaps in air: a = -c v."""
    n, spacing = recipe.masses, recipe.length_m / (recipe.masses - 1)
    rest = np.zeros((n, 3))
    rest[:, 2] = recipe.top_m - spacing * np.arange(n)
    mass = np.full((n, 1), recipe.density_kg_m * spacing)
    mass[[0, -1]] *= 0.5
    x, v, path = rest.copy(), np.zeros((n, 3)), [rest.copy()]
    dt, held = 1.0 / FPS / recipe.steps_per_frame, slice(0, recipe.held)
    for step in range(1, (frames - 1) * recipe.steps_per_frame + 1):
        along, drift = np.diff(x, axis=0), np.diff(v, axis=0)
        now = np.sqrt((along**2).sum(axis=1, keepdims=True))
        unit = along / now
        rate = (drift * unit).sum(axis=1, keepdims=True)
        pull = unit * (
            recipe.stretching_n * (now / spacing - 1.0) + recipe.stretch_dashpot_n_s / spacing * rate
        )
        bend = np.diff(along, axis=0) / spacing**2
        turn = np.diff(drift, axis=0) / spacing**2
        moment = (recipe.bending_n_m2 * bend + recipe.bend_dashpot_n_m2_s * turn) / spacing
        force = mass * GRAVITY
        force[:-1] += pull
        force[1:] -= pull
        force[:-2] -= moment
        force[1:-1] += 2.0 * moment
        force[2:] -= moment
        v = v + dt * force / mass
        if drag_per_s:
            v -= dt * drag_per_s * v
        shift, before = gripped(recipe, step * dt), gripped(recipe, (step - 1) * dt)
        v[held] = (shift - before) / dt
        x = x + dt * v
        x[held] = rest[held] + shift
        if step % recipe.steps_per_frame == 0:
            path.append(x.copy())
    return np.array(path)


def make_scene(recipe: Recipe, path: np.ndarray) -> Scene:
    """The scene as a camera would give it."""
    rng = np.random.default_rng(recipe.seed)
    tracked = np.linspace(0, recipe.masses - 1, 13).round().astype(int)
    clean = path[:, tracked]
    points = clean + rng.normal(0.0, recipe.noise_sigma_m, clean.shape)
    times = np.arange(FRAMES) / FPS
    controllers = path[:, [0, recipe.held - 1]]
    spacing = recipe.length_m / (recipe.masses - 1)
    low = np.array([-0.01, -0.01, recipe.top_m - spacing * (recipe.held - 1) - 1e-6])
    return Scene(
        name=NAME,
        kind="rope",
        description="A rope in a gripper that sways and lifts it (simulated, noisy tracks).",
        points=points.astype(np.float32).astype(np.float64),
        visible=np.ones(points.shape[:2], dtype=bool),
        controllers=controllers.astype(np.float32).astype(np.float64),
        times=times,
        gravity_m_s2=GRAVITY,
        noise_sigma_m=recipe.noise_sigma_m,
        train=(0, TRAIN_FRAMES),
        test=(TRAIN_FRAMES, FRAMES),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(
            length_m=recipe.length_m,
            radius_m=recipe.radius_m,
            segment_rest_lengths_m=np.diff(tracked) * spacing,
        ),
        grips=(Grip((0, 1), low, np.array([0.01, 0.01, recipe.top_m + 0.01]), (0,)),),
        declared={
            "notes": {
                "source": {
                    "script": "scripts/make_sample_rope.py",
                    "engine": "masses and springs with bending, semi-implicit Euler",
                    "seed": recipe.seed,
                    "licence": "Apache-2.0",
                },
                "points_are": "material points along the rope, the held end first",
                "controllers_are": "both ends of the gripped piece, one rigid gripper",
            }
        },
    )


def main() -> None:
    """Write the scene, or print the check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="print the check and write nothing")
    parser.add_argument("--target", type=Path, default=TARGET, help="folder to write (default %(default)s)")
    arguments = parser.parse_args()
    recipe = Recipe()
    path = simulate(recipe)
    if arguments.check:
        half = simulate(replace(recipe, steps_per_frame=2 * recipe.steps_per_frame))
        print(json.dumps({"half_step_m": float(np.linalg.norm(path - half, axis=2).max())}))
        return
    scene, warnings = checked(make_scene(recipe, path))
    write_bundle(scene, arguments.target)
    (arguments.target / "truth.json").write_text(json.dumps(asdict(recipe), indent=1) + "\n")
    print(f"{arguments.target}: points {scene.points.shape}, warnings: {warnings or 'none'}")


if __name__ == "__main__":
    main()
