"""Makes the sample scene ``sample/soft_beam`` with MuJoCo's flex, an engine that is not ours.

A soft beam (0.24 x 0.04 x 0.04 m, linear tetrahedra, St. Venant-Kirchhoff, no damping, no hidden effect)
hangs from a gripper that holds its first 3 cm rigidly, lifts, swings aside and turns for 3 s. 80 material
points on its surface are "tracked" at 30 frames per second with Gaussian noise and runs of occlusion.

    python scripts/make_sample_scene.py            writes sample/soft_beam
    python scripts/make_sample_scene.py --check    prints energy drift and the effect of half the time step

The vertices in the grip are set to the gripper's path after every step: vertices of a flex are point masses,
so this is a Dirichlet condition. MuJoCo gives every vertex the same mass; the script replaces it by the
mass of the tetrahedra around it, since equal masses would make edges and corners heavy.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld_scenes.bundle import checked, write_bundle

NAME = "soft_beam"
TARGET = Path(__file__).resolve().parents[1] / "sample" / NAME

FRAMES = 90
FPS = 30.0
TRAIN_FRAMES = 63
GRAVITY = np.array([0.0, 0.0, -9.81])

CORNERS_OF_CELL = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
EVEN_CELL = np.array([[0, 6, 5, 3], [4, 6, 5, 0], [2, 6, 0, 3], [1, 0, 5, 3], [7, 6, 3, 5]])
ODD_CELL = np.array([[1, 2, 4, 7], [0, 1, 2, 4], [3, 1, 7, 2], [5, 1, 4, 7], [6, 2, 7, 4]])
"""Five tetrahedra of a cube by corner (4 i + 2 j + k); neighbours take the other pattern, so faces match and
the mesh prefers no direction."""


@dataclass(frozen=True)
class Recipe:
    """Everything that the scene depends on. SI units.

    Linear tetrahedra of this size bend about 14 % too stiffly (Richardson from cells of half the size, whose
    tip moves like this mesh at 0.91 times the modulus): a converged simulator finds about 2.85e5 Pa.
    """

    cells: tuple[int, int, int] = (24, 4, 4)
    cell_m: float = 0.01
    corner_m: tuple[float, float, float] = (0.0, -0.02, 0.48)
    grip_m: float = 0.03
    young_pa: float = 2.5e5
    poisson: float = 0.35
    density_kg_m3: float = 600.0
    steps_per_frame: int = 300
    tracked_points: int = 80
    volume_points: int = 1200
    noise_sigma_m: float = 1e-3
    hidden_fraction: float = 0.08
    hidden_run_frames: float = 6.0
    seed: int = 20250

    @property
    def size_m(self) -> np.ndarray:
        """Edges of the undeformed beam, (3,)."""
        return np.array(self.cells) * self.cell_m


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3) [m], tetrahedra (E, 4) with positive volume, vertex masses (V,) [kg]."""

    vertices: np.ndarray
    tetrahedra: np.ndarray
    mass: np.ndarray


def build_mesh(recipe: Recipe) -> Mesh:
    """A box of cells, five tetrahedra each."""
    nx, ny, nz = recipe.cells
    grid = np.stack(np.meshgrid(range(nx + 1), range(ny + 1), range(nz + 1), indexing="ij"), axis=-1)
    vertices = np.array(recipe.corner_m) + grid.reshape(-1, 3) * recipe.cell_m
    tetrahedra = []
    for cell in np.ndindex(nx, ny, nz):
        corner = np.array(cell) + CORNERS_OF_CELL
        index = (corner[:, 0] * (ny + 1) + corner[:, 1]) * (nz + 1) + corner[:, 2]
        tetrahedra.append(index[EVEN_CELL if sum(cell) % 2 == 0 else ODD_CELL])
    elements = np.concatenate(tetrahedra)
    volume = signed_volumes(vertices, elements)
    elements[volume < 0] = elements[volume < 0][:, [0, 2, 1, 3]]
    mass = np.zeros(len(vertices))
    np.add.at(mass, elements, recipe.density_kg_m3 * np.abs(volume)[:, None] / 4.0)
    return Mesh(vertices, elements, mass)


def signed_volumes(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Signed volume of each tetrahedron [m3], (E,)."""
    a, b, c, d = (vertices[tetrahedra[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0


def grip_pose(t: float) -> tuple[np.ndarray, np.ndarray]:
    """The gripper's rotation (3, 3) and shift (3,) [m] at time t [s]; quintic ramps, so C2."""

    def ramp(begin: float, end: float) -> float:
        s = min(max((t - begin) / (end - begin), 0.0), 1.0)
        return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)

    shift = np.array(
        [
            0.05 * ramp(1.2, 2.0) - 0.07 * ramp(2.1, 2.8),
            0.12 * ramp(0.7, 1.6) - 0.10 * ramp(2.0, 2.9),
            0.08 * ramp(0.2, 1.0) - 0.06 * ramp(1.9, 2.6),
        ]
    )
    yaw = np.radians(30.0 * ramp(1.0, 2.0) - 45.0 * ramp(2.1, 3.0))
    pitch = np.radians(-20.0 * ramp(1.5, 2.4))
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return about_z @ about_y, shift


def gripped(recipe: Recipe, rest: np.ndarray, t: float, still: bool = False) -> np.ndarray:
    """Where the gripper has points (n, 3) [m] of the undeformed body at time t."""
    if still:
        return rest
    centre = np.array(recipe.corner_m) + np.array([recipe.grip_m, recipe.size_m[1], recipe.size_m[2]]) / 2.0
    rotation, shift = grip_pose(t)
    return (rest - centre) @ rotation.T + centre + shift


def simulate(
    recipe: Recipe, mesh: Mesh, frames: int = FRAMES, still: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, V, 3) [m] and velocities (T, V, 3) [m/s] of every frame."""
    model = _model(recipe, mesh)
    data = mujoco.MjData(model)
    dt = model.opt.timestep
    held = mesh.vertices[:, 0] <= recipe.corner_m[0] + recipe.grip_m + 1e-9
    rest = mesh.vertices[held]
    dofs = np.repeat(held, 3)
    positions, velocities = [mesh.vertices.copy()], [np.zeros_like(mesh.vertices)]
    for step in range(1, (frames - 1) * recipe.steps_per_frame + 1):
        mujoco.mj_step(model, data)
        now = gripped(recipe, rest, step * dt, still)
        before = gripped(recipe, rest, (step - 1) * dt, still)
        data.qpos[dofs] = (now - rest).ravel()
        data.qvel[dofs] = ((now - before) / dt).ravel()
        if step % recipe.steps_per_frame == 0:
            positions.append(mesh.vertices + data.qpos.reshape(-1, 3))
            velocities.append(data.qvel.reshape(-1, 3).copy())
    return np.stack(positions), np.stack(velocities)


def energies(recipe: Recipe, mesh: Mesh, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Kinetic, elastic (StVK by its definition) and gravitational energy [J] of each frame, (T, 3)."""
    mu = recipe.young_pa / (2.0 * (1.0 + recipe.poisson))
    lam = recipe.young_pa * recipe.poisson / ((1.0 + recipe.poisson) * (1.0 - 2.0 * recipe.poisson))
    volume = signed_volumes(mesh.vertices, mesh.tetrahedra)
    inverse = np.linalg.inv(_edges(mesh.vertices, mesh.tetrahedra))
    table = []
    for x, v in zip(positions, velocities, strict=True):
        F = _edges(x, mesh.tetrahedra) @ inverse
        green = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
        trace = np.trace(green, axis1=1, axis2=2)
        elastic = volume @ (0.5 * lam * trace**2 + mu * (green**2).sum(axis=(1, 2)))
        kinetic = 0.5 * mesh.mass @ (v**2).sum(axis=1)
        table.append((kinetic, elastic, -mesh.mass @ (x - mesh.vertices) @ GRAVITY))
    return np.array(table)


def material_points(recipe: Recipe, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Tracked places on the undeformed surface (N, 3) and places that fill the body (M, 3) [m]."""
    low, size = np.array(recipe.corner_m), recipe.size_m
    candidates = low + rng.random((4000, 3)) * size
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, size=len(candidates), p=area / area.sum())
    row = np.arange(len(candidates))
    candidates[row, axis] = (low + np.round((candidates - low) / size) * size)[row, axis]
    chosen = [0]
    distance = np.full(len(candidates), np.inf)
    while len(chosen) < recipe.tracked_points:
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return candidates[chosen], low + rng.random((recipe.volume_points, 3)) * size


def follow(mesh: Mesh, positions: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Tracks (T, N, 3) [m] of the material points that are at ``places`` (N, 3) in the undeformed mesh."""
    inverse = np.linalg.inv(_edges(mesh.vertices, mesh.tetrahedra))
    origin = mesh.vertices[mesh.tetrahedra[:, 0]]
    tracks = np.empty((len(positions), len(places), 3))
    for i, place in enumerate(places):
        local = np.einsum("eij,ej->ei", inverse, place - origin)
        weights = np.concatenate([1.0 - local.sum(axis=1, keepdims=True), local], axis=1)
        inside = int(np.argmax(weights.min(axis=1)))
        tracks[:, i] = np.einsum("v,tvx->tx", weights[inside], positions[:, mesh.tetrahedra[inside]])
    return tracks


def occlusion(recipe: Recipe, count: int, rng: np.random.Generator) -> np.ndarray:
    """Visibility (T, N): runs of hidden frames of geometric length; everything is visible in frame 0."""
    leave = 1.0 / recipe.hidden_run_frames
    enter = leave * recipe.hidden_fraction / (1.0 - recipe.hidden_fraction)
    visible = np.ones((FRAMES, count), dtype=bool)
    for t in range(1, FRAMES):
        draw = rng.random(count)
        visible[t] = np.where(visible[t - 1], draw >= enter, draw < leave)
    return visible


def grip_handles(region: np.ndarray) -> np.ndarray:
    """The recorded control points: corners and long faces' centres of the gripped box (2, 3) [m], (12, 3)."""
    half = np.diff(region, axis=0)[0] / 2.0
    sides = np.array([[0.0, s, 0.0] for s in (1.0, -1.0)] + [[0.0, 0.0, s] for s in (1.0, -1.0)])
    return np.concatenate([region[CORNERS_OF_CELL, np.arange(3)], region.mean(axis=0) + half * sides])


def grip_velocity(recipe: Recipe, rest: np.ndarray, t: float) -> np.ndarray:
    """Velocity (n, 3) [m/s] of gripped points by a central difference of 20 microseconds."""
    half = 1e-5
    return (gripped(recipe, rest, t + half) - gripped(recipe, rest, t - half)) / (2.0 * half)


def make_scene(recipe: Recipe, mesh: Mesh, positions: np.ndarray) -> Scene:
    """The scene as a camera would give it."""
    rng = np.random.default_rng(recipe.seed)
    places, volume = material_points(recipe, rng)
    clean = follow(mesh, positions, places)
    noisy = clean + rng.normal(0.0, recipe.noise_sigma_m, clean.shape)
    visible = occlusion(recipe, len(places), rng)
    for t in range(1, FRAMES):
        noisy[t] = np.where(visible[t][:, None], noisy[t], noisy[t - 1])
    low, size = np.array(recipe.corner_m), recipe.size_m
    region = np.array([low, low + np.array([recipe.grip_m, size[1], size[2]])])
    handles = grip_handles(region)
    times = np.arange(FRAMES) / FPS
    controllers = np.stack([gripped(recipe, handles, t) for t in times])
    velocities = np.stack([grip_velocity(recipe, handles, t) for t in times])
    inside = np.flatnonzero(places[:, 0] <= low[0] + recipe.grip_m)
    return Scene(
        name=NAME,
        kind="beam",
        description="A soft beam in a gripper that lifts, swings aside and turns (simulated, noisy tracks).",
        points=noisy.astype(np.float32).astype(np.float64),
        visible=visible,
        controllers=controllers.astype(np.float32).astype(np.float64),
        controller_velocities=velocities.astype(np.float32).astype(np.float64),
        times=times,
        rest_volume_points=volume.astype(np.float32).astype(np.float64),
        gravity_m_s2=GRAVITY,
        noise_sigma_m=recipe.noise_sigma_m,
        train=(0, TRAIN_FRAMES),
        test=(TRAIN_FRAMES, FRAMES),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(size_m=size, box_min_m=low, box_max_m=low + size, density_kg_m3=recipe.density_kg_m3),
        grips=(Grip(tuple(range(len(handles))), region[0], region[1], tuple(int(i) for i in inside)),),
        declared={
            "body": {"material": "homogeneous isotropic elastic solid, stiffness unknown"},
            "notes": {
                "source": {
                    "script": "scripts/make_sample_scene.py",
                    "engine": "MuJoCo flex, linear tetrahedra, St. Venant-Kirchhoff, no damping",
                    "engine_version": mujoco.__version__,
                    "seed": recipe.seed,
                    "licence": "Apache-2.0",
                },
                "points_are": "material points on the beam's surface, those in the grip included",
                "controllers_are": "corners and face centres of the gripped box, one rigid gripper",
            },
        },
    )


def check(recipe: Recipe, frames: int = FRAMES) -> dict[str, float]:
    """Figures that say whether the physics can be trusted.

    Returns:
        ``energy_drift``: largest change of the total energy over the first second with the gripper held
        still, over the largest kinetic energy; ``half_step_m``: largest difference of a track when the time
        step is halved; ``largest_step_m``: the longest way of a track between two frames.
    """
    mesh = build_mesh(recipe)
    still = simulate(recipe, mesh, frames=31, still=True)
    table = energies(recipe, mesh, *still)
    drift = np.abs(table.sum(axis=1) - table[0].sum()).max() / table[:, 0].max()
    places, _ = material_points(recipe, np.random.default_rng(recipe.seed))
    coarse = follow(mesh, simulate(recipe, mesh, frames)[0], places)
    half = Recipe(**{**asdict(recipe), "steps_per_frame": 2 * recipe.steps_per_frame})
    fine = follow(mesh, simulate(half, mesh, frames)[0], places)
    return {
        "energy_drift": float(drift),
        "half_step_m": float(np.linalg.norm(coarse - fine, axis=2).max()),
        "largest_step_m": float(np.linalg.norm(np.diff(coarse, axis=0), axis=2).max()),
    }


def main() -> None:
    """Write the scene, or print the checks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="print the physics checks and write nothing")
    parser.add_argument("--target", type=Path, default=TARGET, help="folder to write (default %(default)s)")
    parser.add_argument(
        "--cells",
        type=int,
        nargs=3,
        default=Recipe.cells,
        help="hexahedra along x, y, z (default %(default)s)",
    )
    arguments = parser.parse_args()
    recipe = Recipe(cells=tuple(arguments.cells))
    if arguments.check:
        print(json.dumps(check(recipe), indent=1))
        return
    mesh = build_mesh(recipe)
    scene, warnings = checked(make_scene(recipe, mesh, simulate(recipe, mesh)[0]))
    write_bundle(scene, arguments.target)
    engine = {"engine": "MuJoCo flex", "engine_version": mujoco.__version__, "effect": "none"}
    (arguments.target / "truth.json").write_text(json.dumps(asdict(recipe) | engine, indent=1) + "\n")
    print(f"{arguments.target}: points {scene.points.shape}, warnings: {warnings or 'none'}")


def _report(message: str) -> None:
    """MuJoCo's warnings to stderr, not to a file in the working folder.

    One is known to be wrong: it says that the flex has no passive forces, but ``energies`` sees them work.
    """
    if "no equality constraints or passive forces" not in message:
        print(message, file=sys.stderr)


def _model(recipe: Recipe, mesh: Mesh) -> mujoco.MjModel:
    points = " ".join(f"{x:.9g}" for x in mesh.vertices.ravel())
    elements = " ".join(str(i) for i in mesh.tetrahedra.ravel())
    xml = f"""<mujoco><option timestep="{1.0 / (FPS * recipe.steps_per_frame):.17g}" integrator="Euler"
    gravity="{GRAVITY[0]} {GRAVITY[1]} {GRAVITY[2]}"><flag contact="disable" constraint="disable"/></option>
    <size memory="200M"/><worldbody>
    <flexcomp name="beam" type="direct" dim="3" mass="1" radius="0.0005"
     point="{points}" element="{elements}">
    <contact selfcollide="none" contype="0" conaffinity="0"/>
    <elasticity young="{recipe.young_pa}" poisson="{recipe.poisson}" damping="0"/></flexcomp>
    </worldbody></mujoco>"""
    mujoco.set_mju_user_warning(_report)
    model = mujoco.MjModel.from_xml_string(xml)
    model.body_mass[1:] = mesh.mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _edges(x: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Edge matrices of the tetrahedra, columns x_i - x_0, (E, 3, 3)."""
    return np.stack([x[tetrahedra[:, i]] - x[tetrahedra[:, 0]] for i in (1, 2, 3)], axis=-1)


if __name__ == "__main__":
    main()
