"""A bar of masses and springs held at one end: a tiny world to learn, independent of the engine."""

from __future__ import annotations

from functools import cache

import numpy as np

from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph

DT_S = 1.0 / 30.0
SPACING_M = 0.02
COLUMNS, ROWS = 9, 2
SUBSTEPS = 60
GRAVITY_M_S2 = (0.0, 0.0, -1.0)
SMALL = WorldModelConfig(hidden=16, message_passing_steps=3, history=2, vertices=30, neighbours=5, modes=6)


def lattice() -> np.ndarray:
    """Particles at rest [m], (36, 3): a bar of 9 by 2 by 2."""
    axes = (np.arange(COLUMNS), np.arange(ROWS), np.arange(ROWS))
    return SPACING_M * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)


def grip(rest: np.ndarray) -> np.ndarray:
    """Particles that the grip holds: the first column."""
    return np.nonzero(rest[:, 0] < 0.5 * SPACING_M)[0]


def graph(
    config: WorldModelConfig = SMALL, ground_height_m: float | None = None, *, framed: bool = False
) -> GraphSpec:
    """The bar's graph; its controllers are the held particles, one rigid group."""
    rest = lattice()
    controllers = rest[grip(rest)]
    return build_graph(
        rest,
        rest,
        controllers,
        dt_s=DT_S,
        config=config,
        control_groups=(np.arange(len(controllers)),),
        ground_height_m=ground_height_m,
        gravity_m_s2=np.array(GRAVITY_M_S2) if framed else None,
    )


@cache
def episode(seed: int, frames: int = 40) -> dict[str, np.ndarray]:
    """One episode: the grip swings smoothly, the stiffness is scaled by a random factor. Its arrays are shared."""
    rng = np.random.default_rng(seed)
    rest = lattice()
    held = grip(rest)
    i, j = np.nonzero(np.triu(np.linalg.norm(rest[:, None] - rest[None], axis=2) < 1.8 * SPACING_M, 1))
    ends = np.zeros((len(i), len(rest)))  # of each spring: -1 and 1
    ends[np.arange(len(i)), i], ends[np.arange(len(i)), j] = -1.0, 1.0
    length = np.linalg.norm(ends @ rest, axis=1)
    log_stiffness = rng.normal(0.0, 0.5)
    stiffness, damping = 10_000.0 * np.exp(log_stiffness), 40.0
    rate, phase = rng.uniform(4.0, 8.0, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    swing = 0.02 * rng.normal(size=3)
    step = DT_S / SUBSTEPS
    x, v, path = rest.copy(), np.zeros_like(rest), [rest.copy()]
    for tick in range(1, (frames - 1) * SUBSTEPS + 1):
        along = ends @ x
        now = np.sqrt(np.einsum("ij,ij->i", along, along))
        unit = along / now[:, None]
        pull = stiffness * (now - length)[:, None] * unit + damping * (ends @ v)
        v = v + step * (np.array(GRAVITY_M_S2) - ends.T @ pull)
        x = x + step * v
        x[held] = rest[held] + swing * (np.sin(rate * tick * step + phase) - np.sin(phase))
        v[held] = swing * rate * np.cos(rate * tick * step + phase)
        if tick % SUBSTEPS == 0:
            path.append(x.copy())
    particles = np.array(path)
    properties = np.zeros((len(rest), 2))
    properties[:, 0] = log_stiffness
    return {
        "times": np.arange(frames) * DT_S,
        "particles": particles.astype(np.float32),
        "controllers": particles[:, held].astype(np.float32),
        "properties": properties.astype(np.float32),
    }
