"""Three small twins, one of each dimension, held at one end and moved: what every effect is tried on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import FPS, box_body, made_scene
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from physworld.effects.dry_friction import SLOW_M_S
from physworld.engine.problem import nodal_mass
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

FRAMES = 8
SIZE = np.array([0.16, 0.04, 0.04])
PLATE = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.0, 0.03]])


def _moved(scene: Scene) -> Scene:
    lift = np.sin(6.0 * scene.times)[:, None, None] ** 2 * np.array([0.01, 0.02, 0.02])
    return replace(scene, controllers=scene.controllers + lift)


def solid() -> Scene:
    """A bar on the ground, its first fifth gripped."""
    points = np.linspace([0.04, 0.02, 0.04], [0.16, 0.02, 0.04], 4)
    grips = (Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.04, 0.04])),)
    body = box_body([0, 0, 0], SIZE, density_kg_m3=500.0)
    return _moved(
        made_scene(points, "beam", PLATE, FRAMES, body=body, grips=grips, ground=Ground(-0.003, 0.4),
                   initial_state=UNDEFORMED_AT_REST)
    )  # fmt: skip


def sheet() -> Scene:
    """A square sheet above the ground, one corner held."""
    plane = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.concatenate([plane, np.zeros((9, 1))], axis=1)
    scene = made_scene(
        points,
        "sheet",
        PLATE,
        FRAMES,
        body=Body(thickness_m=2e-3),
        initial_state=UNDEFORMED_AT_REST,
        ground=Ground(-0.01, 0.4),
    )
    return _moved(scene)


def rope() -> Scene:
    """A rope above the ground, held at its first end."""
    points = np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 5)
    body = Body(radius_m=0.004)
    return _moved(
        made_scene(
            points,
            "rope",
            PLATE[:1],
            FRAMES,
            body=body,
            initial_state=UNDEFORMED_AT_REST,
            ground=Ground(-0.01, 0.4),
        )
    )


SCENES = {"solid": solid, "sheet": sheet, "rope": rope}
TWINS = {name: build_twin(make(), 300) for name, make in SCENES.items()}


def simulated(twin: Twin, scene: Scene) -> np.ndarray:
    """Nodes over the scene's frames, (T, n, 3)."""
    return twin.simulate_nodes(*scene.control_track(), scene.times)


def loose(name: str, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0), **parameters: float) -> Twin:
    """The twin held by nobody, far from the ground."""
    twin = replace(TWINS[name], held_nodes=(), controller_groups=(), controllers_start=np.empty((0, 3)))
    return replace(twin, ground_height_m=None, gravity_m_s2=np.array(gravity)).with_parameters(**parameters)


def moved(twin: Twin, times: np.ndarray, start_velocity: np.ndarray | None = None) -> np.ndarray:
    """Nodes (T, n, 3) under controls that stand still."""
    if start_velocity is not None:
        twin = replace(twin, body=replace(twin.body, start_velocity=start_velocity))
    still = np.repeat(twin.controllers_start[None], 2, axis=0)
    return twin.simulate_nodes(times[[0, -1]], still, times)


def centroid(twin: Twin, nodes: np.ndarray) -> np.ndarray:
    """Centre of mass relative to the first frame's, (T, 3)."""
    mass = nodal_mass(twin.lattice, twin.law, None)
    centre = np.einsum("n,tni->ti", mass, nodes) / mass.sum()
    return centre - centre[0]


def rubbed_fall(times: np.ndarray, size: float) -> np.ndarray:
    """Height (T,) [m] of what falls from rest against a dry friction [m/s^2]."""
    return solve_ivp(
        lambda _, y: [y[1], -9.81 - size * y[1] / np.hypot(y[1], SLOW_M_S)],
        (0.0, times[-1]), (0.0, 0.0), t_eval=times, rtol=1e-10, atol=1e-12,
    ).y[0]  # fmt: skip


def swirled(times: np.ndarray, spin: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Way (T, 3) [m] of what begins at rest ``off`` (3,) [m] the axis of a swirl (3,) [1/s^2]: x'' = s x (x - c)."""
    rates = np.zeros((6, 6))
    rates[:3, 3:], rates[3:, :3] = np.eye(3), np.cross(spin, np.eye(3)).T
    return np.array([(expm(rates * t) @ np.concatenate([off, np.zeros(3)]))[:3] - off for t in times])


__all__ = [
    "FPS", "FRAMES", "SCENES", "TWINS", "centroid", "loose", "moved", "rubbed_fall", "simulated", "swirled",
]  # fmt: skip
