"""The objects of ``docs/gallery.md``: the two shipped samples, and four that the engine simulates.

The samples are calibrated and shown with their measured points. The other four have declared materials: a cloth, a
block of clay under a ball, a column of sand, and a soft block that a ball pushes over a table. SI units, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.materials.plastic import DruckerPrager, VonMises
from physworld.scene import UNDEFORMED_AT_REST, Body, DeclaredCollider, Grip, Ground, Scene
from physworld.twin.build import build_twin
from physworld_scenes.bundle import read_bundle
from physworld_services.dashboard.surfaces import Surface
from physworld_services.dashboard.tubes import Tubes
from scripts.gallery_surface import surface_of_twin

SAMPLES = Path(__file__).resolve().parents[1] / "sample"
GRAVITY = np.array([0.0, 0.0, -9.81])
FPS = 30.0
BALL_RADIUS_M = 0.025
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # quaternion, scalar first


@dataclass(frozen=True)
class Motion:
    """What a film shows.

    Attributes:
        times: of the frames [s], (T,).
        particles: of the simulation [m], (T, P, 3).
        surface: of the body, carried by the particles; None draws the particles themselves.
        measured: points with where they are visible, (T, N, 3) and (T, N); None where nothing was measured.
        ball: middle of a ball of ``BALL_RADIUS_M`` [m], (T, 3), or None.
        ground_m: height of the ground, or None.
        held_out: mean track error and noise floor of the held-out frames [m], or None.
        first_held_out: number of the first held-out frame, or None.
        slower: how many times slower than real time the film is.
    """

    times: Array
    particles: Array
    surface: Surface | Tubes | None = None
    measured: tuple[Array, Array] | None = None
    ball: Array | None = None
    ground_m: float | None = None
    held_out: tuple[float, float] | None = None
    first_held_out: int | None = None
    slower: float = 1.0


@dataclass(frozen=True)
class Exhibit:
    """One object of the gallery.

    Attributes:
        name: of its files.
        title, caption: of its section.
        make: simulates it, given a number of particles.
        azimuth_deg, elevation_deg: where it is seen from.
        particles: about how many the simulation has.
        colour: of one half of the checks, in [0, 1].
        check_m: side of the cells that the colours alternate by.
    """

    name: str
    title: str
    caption: str
    make: Callable[[int], Motion]
    azimuth_deg: float = -60.0
    elevation_deg: float = 18.0
    particles: int = 1500
    colour: tuple[float, float, float] = (0.36, 0.65, 0.92)
    check_m: float = 0.02


def calibrated(name: str, budget: int, simulations: int = 400) -> Motion:
    """A shipped sample and its twin, which knows the start and the gripper's motion."""
    from physworld.evaluate.metrics import track_error_per_frame

    scene = read_bundle(SAMPLES / name)
    found = calibrate(scene, CalibrationConfig(particle_budget=budget, max_simulations=simulations))
    errors = track_error_per_frame(found.tracks, scene.points, scene.visible)
    floor = float((scene.noise_sigma_m or 0.0) * np.sqrt(8.0 / np.pi))
    return Motion(
        scene.times,
        found.particles,
        surface_of_twin(found.twin),
        measured=(scene.points, scene.visible),
        held_out=(float(errors[slice(*scene.test)].mean()), floor),
        first_held_out=scene.test[0],
    )


def cloth(budget: int) -> Motion:
    """A square of cloth, held at two corners, is swung to and fro and lifted."""
    side, held = 0.3, 0.03
    times = _times(3.0)
    low = np.array([[0.0, -0.01, side - held], [side - held, -0.01, side - held]])
    high = low + np.array([held, 0.02, held])
    corners = [
        [x, 0.0, z] for a, b in zip(low, high, strict=True) for x in (a[0], b[0]) for z in (a[2], b[2])
    ]
    aside = 0.12 * np.sin(2.6 * np.pi * times) * _ramp(times, 0.0, 0.5)
    path = np.stack([0.0 * times, aside, 0.08 * _ramp(times, 1.5, 2.5)], axis=1)
    scene = _scene(
        "sheet",
        np.array([[x, 0.0, z] for x in np.linspace(0, side, 9) for z in np.linspace(0, side, 9)]),
        times,
        np.array(corners) + path[:, None],
        body=Body(size_m=np.array([side, 1e-3, side]), thickness_m=1e-3, density_kg_m3=300.0),
        grips=tuple(Grip(tuple(range(4 * k, 4 * k + 4)), low[k], high[k]) for k in range(2)),
    )
    twin = build_twin(scene, budget).with_parameters(membrane_n_m=100.0, bending_n_m=1e-5, air_drag_per_s=1.5)
    return Motion(times, twin.simulate(times, scene.controllers, times), surface_of_twin(twin))


def clay(budget: int) -> Motion:
    """A block that yields: a ball presses into it and leaves its mark."""
    times = _times(2.0)
    middle = np.zeros((len(times), 3))
    middle[:, 2] = 0.085 - 0.045 * _ramp(times, 0.2, 0.9) + 0.06 * _ramp(times, 1.2, 1.9)
    scene = _on_a_table("block", np.array([0.12, 0.12, 0.05]), times, middle, density=1200.0)
    twin = build_twin(scene, budget, plasticity=VonMises(3e3)).with_parameters(youngs_modulus_pa=2e5)
    particles = twin.simulate(times, scene.controllers, times)
    return Motion(times, particles, surface_of_twin(twin), ball=middle, ground_m=0.0)


def sand(budget: int) -> Motion:
    """A column of grains that falls into a heap."""
    times = _times(0.6, 4.0 * FPS)
    scene = _on_a_table("sand", np.array([0.06, 0.06, 0.12]), times, None, density=1500.0, friction=0.5)
    twin = build_twin(scene, budget, plasticity=DruckerPrager(np.radians(32.0)))
    twin = twin.with_parameters(youngs_modulus_pa=3e5)
    return Motion(times, twin.simulate(times, scene.controllers, times), ground_m=0.0, slower=4.0)


def pushed(budget: int) -> Motion:
    """A soft block on a table; a ball pushes it at half its height, stops, and goes back."""
    times = _times(2.0)
    middle = np.tile([-0.09, 0.0, 0.045], (len(times), 1))
    middle[:, 0] += 0.10 * _ramp(times, 0.1, 1.0) - 0.08 * _ramp(times, 1.2, 1.8)
    scene = _on_a_table("block", np.array([0.1, 0.08, 0.08]), times, middle, density=300.0, friction=0.9)
    twin = build_twin(scene, budget).with_parameters(youngs_modulus_pa=4e3)
    particles = twin.simulate(times, scene.controllers, times)
    return Motion(times, particles, surface_of_twin(twin), ball=middle, ground_m=0.0)


EXHIBITS = (
    Exhibit(
        "soft_beam",
        "A soft beam in a gripper",
        "The shipped sample. Dark: measured points, where the tracking saw them. In colour: the calibrated twin.",
        lambda budget: calibrated("soft_beam", budget),
    ),
    Exhibit(
        "hanging_rope",
        "A rope that a gripper sways and lifts",
        "The second shipped sample, with the same colours.",
        lambda budget: calibrated("hanging_rope", budget),
        azimuth_deg=-75.0,
        colour=(0.95, 0.62, 0.25),
        check_m=0.05,
    ),
    Exhibit(
        "cloth",
        "A cloth that is held at two corners",
        "Simulated as a thin sheet with air around it.",
        cloth,
        azimuth_deg=-50.0,
        particles=2500,
        colour=(0.86, 0.42, 0.55),
        check_m=0.03,
    ),
    Exhibit(
        "clay",
        "A block of clay",
        "It yields at 3 kPa (`von_mises`), so the ball leaves its mark. Integrated by material points on a grid.",
        clay,
        elevation_deg=30.0,
        particles=6000,
        colour=(0.83, 0.47, 0.33),
    ),
    Exhibit(
        "sand",
        "A column of sand",
        "Grains with an angle of friction of 32° (`drucker_prager`) fall into a heap, four times slower than in"
        " reality.",
        sand,
        particles=6000,
        colour=(0.90, 0.76, 0.48),
    ),
    Exhibit(
        "pushed",
        "A soft block on a table",
        "A ball pushes it against the friction of the table and lets it spring back.",
        pushed,
        azimuth_deg=-80.0,
        elevation_deg=15.0,
        particles=3000,
        colour=(0.40, 0.74, 0.50),
    ),
)


def _times(seconds: float, rate: float = FPS) -> Array:
    return np.arange(round(seconds * rate) + 1) / rate


def _ramp(times: Array, begin: float, end: float) -> Array:
    """From 0 to 1, twice continuously differentiable."""
    s = np.clip((times - begin) / (end - begin), 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def _scene(kind: str, points: Array, times: Array, controllers: Array, **facts: object) -> Scene:
    """A scene whose points stand still: the simulation is what moves."""
    split = round(0.7 * len(times))
    fields: dict[str, object] = {
        "name": kind,
        "kind": kind,
        "points": np.repeat(points[None], len(times), axis=0),
        "visible": np.ones((len(times), len(points)), dtype=bool),
        "controllers": controllers,
        "times": times,
        "gravity_m_s2": GRAVITY,
        "noise_sigma_m": 1e-3,
        "train": (0, split),
        "test": (split, len(times)),
        "fps": FPS,
        "initial_state": UNDEFORMED_AT_REST,
    }
    return Scene(**{**fields, **facts})  # type: ignore[arg-type]


def _on_a_table(
    kind: str, size: Array, times: Array, ball: Array | None, density: float, friction: float = 0.4
) -> Scene:
    """A box of this size (3,) [m] on a table, and the ball whose middle moves along ``ball`` (T, 3)."""
    low, high = size * [-0.5, -0.5, 0.0], size * [0.5, 0.5, 1.0]
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    beside: dict[str, object] = {}
    if ball is not None:
        poses = np.concatenate([ball, np.tile(UPRIGHT, (len(times), 1))], axis=1)
        declared = DeclaredCollider(
            "ball", "sphere", radius_m=BALL_RADIUS_M, poses="ball_poses", friction=0.3
        )
        beside = {"colliders": (declared,), "extra_arrays": {"ball_poses": poses}}
    return _scene(
        kind,
        corners,
        times,
        np.zeros((len(times), 0, 3)),
        body=Body(size_m=size, box_min_m=low, box_max_m=high, density_kg_m3=density),
        ground=Ground(0.0, friction),
        **beside,
    )
