"""Small objects on which ``benchmarks.trace.power`` injects effects: a beam, a rope, a sheet, and a pad on a ground.

Each is recorded by a twin of the project's own engine on cells 1.4 times smaller than the fit's (so nodes, particles
and time step differ), with tracking noise on every frame. The motion of the grip and the stiffness are drawn anew for
every seed; seed 0 is the object on which effects are injected. A bar recorded by the updated Lagrangian form (MPM with
APIC transfers) stands for the engines that damp: it has no declared effect, but its transfers take energy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from physworld.calibrate import CalibrationConfig
from physworld.evaluate.numerics import refined
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene
from physworld.trace import TraceConfig
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SIGMA_M = 1e-3
FPS, FRAMES, TRAIN = 30.0, 30, 21
REFINEMENT = 1.4  # of the recording's cells over the fit's
GRAVITY = np.array([0.0, 0.0, -9.81])
_STIFFNESS_SPREAD = 0.2  # of the logarithm of what a null's stiffness is multiplied with


@dataclass(frozen=True)
class Object:
    """One recorded object.

    Attributes:
        scene: what is declared, with the grip's motion; its points are those of the first frame.
        truth: the twin that records it, without an effect.
        budget: particles of the fit's twin, about.
    """

    scene: Scene
    truth: Twin
    budget: int

    def config(self) -> TraceConfig:
        """Settings of its trace: the defaults on a small body, without the search for a next experiment."""
        calibration = CalibrationConfig(particle_budget=self.budget, damping="none")
        return TraceConfig(calibration=calibration, bootstraps=200, experiment=None)


def observed(twin: Twin, scene: Scene) -> np.ndarray:
    """Points (T, N, 3) [m] as the camera reports them without noise. Raises SimulationError."""
    return twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)


def recorded(scene: Scene, tracks: np.ndarray, seed: int) -> Scene:
    """The scene with these tracks and fresh noise."""
    noise = np.random.default_rng([seed, 1]).normal(scale=SIGMA_M, size=tracks.shape)
    return replace(scene, points=tracks + noise, noise_sigma_m=SIGMA_M)


def beam(seed: int) -> Object:
    """A soft bar, its first fifth gripped, that starts level and is moved up, down and sideways."""
    low, high = np.array([0.0, -0.02, -0.02]), np.array([0.2, 0.02, 0.02])
    corners = [
        [x, y, z] for x in np.linspace(0.06, 0.2, 4) for y in (low[1], high[1]) for z in (low[2], high[2])
    ]
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    body = Body(box_min_m=low, box_max_m=high, density_kg_m3=800.0)
    grips = (Grip((0, 1, 2, 3), low, np.array([0.04, high[1], high[2]])),)
    scene = _scene("beam", corners, grip, body, grips)
    scene = _moved(scene, seed, np.array([0.007, 0.025, 0.018]))
    return _recorded_by(scene, seed, 250, {"youngs_modulus_pa": 1e5, "poissons_ratio": 0.35})


def pad(seed: int) -> Object:
    """A soft block that lies on a ground and is dragged by one end."""
    low, high = np.array([0.0, -0.03, 0.0]), np.array([0.15, 0.03, 0.04])
    corners = [
        [x, y, z] for x in np.linspace(0.05, 0.15, 4) for y in (low[1], high[1]) for z in (0.005, high[2])
    ]
    grip = np.array([[0.0, y, z] for y in (-0.02, 0.02) for z in (0.01, 0.03)])
    body = Body(box_min_m=low, box_max_m=high, density_kg_m3=500.0)
    grips = (Grip((0, 1, 2, 3), low, np.array([0.03, high[1], high[2]])),)
    scene = _scene("block", corners, grip, body, grips, Ground(0.0, 0.4))
    scene = _moved(scene, seed, np.array([0.02, 0.03, 0.012]))
    return _recorded_by(scene, seed, 200, {"youngs_modulus_pa": 3e4, "poissons_ratio": 0.35})


def rope(seed: int) -> Object:
    """A rope that hangs from a grip which swings it."""
    length, count = 0.4, 9
    points = [[0.0, 0.0, -z] for z in np.linspace(0.02, length, count)]
    body = Body(length_m=length, radius_m=0.004, density_kg_m3=900.0)
    scene = _scene("rope", points, np.array([[0.0, 0.0, 0.0]]), body)
    scene = _moved(scene, seed, np.array([0.05, 0.04, 0.02]))
    return _recorded_by(scene, seed, 60, {"bending_n_m2": 2e-4})


def sheet(seed: int) -> Object:
    """A soft sheet that hangs from a bar along its upper edge and is swung."""
    side, count = 0.2, 5
    places = np.linspace(0.0, side, count)
    points = [[x, 0.0, -z] for z in places[1:] for x in places]
    grip = np.array([[0.0, 0.0, 0.0], [side / 2, 0.0, 0.0], [side, 0.0, 0.0]])
    body = Body(side_m=side, thickness_m=0.01, density_kg_m3=300.0)
    edge = 0.02
    grips = (Grip((0, 1, 2), np.array([-edge, -edge, -edge]), np.array([side + edge, edge, edge])),)
    scene = _scene("sheet", np.concatenate([grip, points])[3:], grip, body, grips)
    scene = _moved(scene, seed, np.array([0.02, 0.04, 0.02]))
    thickness, modulus = 0.01, 2e5
    membrane = modulus * thickness / (1 - 0.3**2)
    law = {"membrane_n_m": membrane, "bending_n_m": membrane * thickness**2 / 12}
    return _recorded_by(scene, seed, 60, law)


def damped(seed: int) -> Object:
    """The beam as the updated Lagrangian form records it: particles, APIC transfers, and their damping."""
    known = beam(seed)
    other = build_twin(known.scene, known.budget, refinement=REFINEMENT, formulation="updated_lagrangian")
    body = replace(other.body, points=known.truth.body.points, offsets=known.truth.body.offsets)
    return replace(known, truth=replace(other, body=body, law=known.truth.law))


GROUND_ONLY, NULLS_ONLY = "pad", "damped"
"""The one takes the effects that all others refuse; the other is recorded without effects only."""
OBJECTS: dict[str, Callable[[int], Object]] = {
    "beam": beam, "rope": rope, "sheet": sheet, GROUND_ONLY: pad, NULLS_ONLY: damped
}  # fmt: skip


def _scene(
    kind: str,
    points: np.ndarray | list,
    grip: np.ndarray,
    body: Body,
    grips: tuple[Grip, ...] | None = None,
    ground: Ground | None = None,
) -> Scene:
    start = np.asarray(points, dtype=float)
    return Scene(
        name=f"power_{kind}",
        kind=kind,
        points=np.repeat(start[None], FRAMES, axis=0),
        visible=np.ones((FRAMES, len(start)), dtype=bool),
        controllers=np.repeat(grip[None], FRAMES, axis=0),
        times=np.arange(FRAMES) / FPS,
        gravity_m_s2=GRAVITY,
        noise_sigma_m=SIGMA_M,
        train=(0, TRAIN),
        test=(TRAIN, FRAMES),
        fps=FPS,
        body=body,
        grips=grips or (),
        ground=ground,
        initial_state=UNDEFORMED_AT_REST,
    )


def _moved(scene: Scene, seed: int, stroke: np.ndarray) -> Scene:
    """The grip moves smoothly from rest: two sines an axis, of sizes and rates that the seed draws."""
    rng = np.random.default_rng([seed, 0])
    rates = rng.uniform(6.0, 12.0, size=(2, 3))
    sizes = stroke * rng.uniform(0.5, 1.0, size=(2, 3)) * rng.choice([-1.0, 1.0], size=(2, 3))
    waves = 0.5 * (1.0 - np.cos(rates * scene.times[:, None, None]))  # at rest at the start
    path = (sizes * waves).sum(axis=1)
    return replace(scene, controllers=scene.controllers + path[:, None])


def _recorded_by(scene: Scene, seed: int, budget: int, law: dict[str, float]) -> Object:
    twin = build_twin(scene, budget)
    factor = 1.0
    if seed:
        factor = float(np.exp(np.random.default_rng([seed, 2]).normal(scale=_STIFFNESS_SPREAD)))
    stiff = {name: value * (1.0 if name == "poissons_ratio" else factor) for name, value in law.items()}
    finer = refined(scene, twin.with_parameters(**stiff), budget, REFINEMENT)
    return Object(scene, finer, budget)
