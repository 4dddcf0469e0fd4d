"""A rope of point masses that grips swing: a world to learn in which everything turns, independent of the engine.

Springs between neighbours, and straight at rest: bending forces from second differences. ``markers`` 3: one grip of
three controllers that are not in line; 2: a grip of two at either end, as motion capture gives it.
"""

from __future__ import annotations

import numpy as np

from physworld.geometry.rigid import least_rotation
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph

DT_S = 1.0 / 30.0
SPACING_M, COUNT, HELD = 0.02, 25, 3
LENGTH_M = SPACING_M * (COUNT - 1)
WAVE_M_S, BENDING_M4_S2, DRAG_PER_S = 18.0, 6e-3, 0.3
SUBSTEPS = 60
SMALL = WorldModelConfig(hidden=16, message_passing_steps=2, history=2, vertices=40, neighbours=5, modes=12)
MARKERS = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.01], [0.0, 0.02, 0.0]])


def rest() -> np.ndarray:
    """Places without force [m], (25, 3)."""
    return np.outer(np.arange(COUNT) * SPACING_M, [1.0, 0.0, 0.0])


def start(markers: int) -> np.ndarray:
    """Places at the start [m]: straight, or an arc between two grips."""
    if markers == 3:
        return rest()
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, COUNT - 1) * 0.9
    steps = np.stack([np.cos(angle), np.zeros(COUNT - 1), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(SPACING_M * steps, axis=0)])


def grips(markers: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each grip: its controllers, their places at the start [m], and the particles that it holds."""
    places = start(markers)
    if markers == 3:
        return [(np.arange(3), MARKERS, np.arange(HELD))]
    ends = (np.arange(HELD), np.arange(COUNT - HELD, COUNT))
    return [(2 * g + np.arange(2), places[held[[0, 1]]], held) for g, held in enumerate(ends)]


def graph(markers: int = 3, config: WorldModelConfig = SMALL) -> GraphSpec:
    """The rope's graph."""
    hands = grips(markers)
    return build_graph(
        rest(),
        start(markers),
        np.concatenate([places for _, places, _ in hands]),
        dt_s=DT_S,
        config=config,
        control_groups=tuple(own for own, _, _ in hands),
    )


def episode(seed: int, frames: int = 45, markers: int = 3) -> dict[str, np.ndarray]:
    """One episode: the grips move and turn smoothly, stiffness and mass are scaled by random factors."""
    rng = np.random.default_rng(seed)
    stiff, heavy = rng.normal(0.0, 0.2), rng.normal(0.0, 0.1)
    hands = grips(markers)
    motions = [
        (rng.uniform(2.0, 7.0, 3), 0.06 * rng.normal(size=3), rng.uniform(2.0, 5.0), 0.5 * rng.normal(size=3))
        for _ in hands
    ]
    step = DT_S / SUBSTEPS
    ratio = np.exp(stiff - heavy)
    pull, bend = ratio * WAVE_M_S**2 / SPACING_M**2, ratio * BENDING_M4_S2 / SPACING_M**4
    x = start(markers)
    v, path, controls = np.zeros_like(x), [], []
    begin = x.copy()
    for tick in range((frames - 1) * SUBSTEPS + 1):
        led = []
        for (_, places, held), (rate, swing, turning, lean) in zip(hands, motions, strict=True):
            shift = swing * (1.0 - np.cos(rate * tick * step))
            turn = _turned(places, lean * (1.0 - np.cos(turning * tick * step)), markers)
            centre = places.mean(axis=0)
            x[held] = (begin[held] - centre) @ turn.T + centre + shift
            led.append((places - centre) @ turn.T + centre + shift)
        if tick % SUBSTEPS == 0:
            path.append(x.copy())
            controls.append(np.concatenate(led))
        along = np.diff(x, axis=0)
        size = np.linalg.norm(along, axis=1, keepdims=True)
        drawn = np.pad(pull * (1.0 - SPACING_M / size) * along, ((1, 1), (0, 0)))
        bent = np.pad(np.diff(x, n=2, axis=0), ((2, 2), (0, 0)))
        force = np.diff(drawn, axis=0) - bend * np.diff(bent, n=2, axis=0)
        v = v + step * (force - DRAG_PER_S * v - [0.0, 0.0, 9.81])
        x = x + step * v
    return {
        "times": np.arange(frames) * DT_S,
        "particles": np.array(path, dtype=np.float32),
        "controllers": np.array(controls, dtype=np.float32),
        "properties": np.tile(np.array([stiff, heavy], dtype=np.float32), (COUNT, 1)),
    }


def _turned(places: np.ndarray, vector: np.ndarray, markers: int) -> np.ndarray:
    """A rotation by ``vector``; of two markers, the least one that turns their direction as it does."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    a, b, c = vector / angle
    skew = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    whole = np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew
    if markers == 3:
        return whole
    direction = places[1] - places[0]
    return least_rotation(direction, direction @ whole.T)
