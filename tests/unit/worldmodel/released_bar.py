"""A bar of masses and springs between two grips, of which the second lets go for a while: a world to learn in which
what holds the body changes, independent of the engine.

Episodes are integrated side by side. While the second grip is open its controllers are the rigid motion of the
particles that it held; from closing on it moves them, and what it holds, from where they are.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from physworld.geometry.rigid import rigid_motion
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph

DT_S, SPACING_M, SUBSTEPS = 1.0 / 30.0, 0.02, 30
COLUMNS, ROWS, FRAMES = 9, 2, 60
GRAVITY_M_S2 = np.array([0.0, 0.0, -0.5])
STIFFNESS_S2, DAMPING_S = 8_000.0, 40.0
GRIPS = (np.arange(4), np.arange(4, 8))
BOTH, LEFT = (0, 1), (0,)
SMALL = WorldModelConfig(hidden=16, message_passing_steps=2, history=2, vertices=36, neighbours=5, modes=12)


def lattice() -> np.ndarray:
    """Particles at rest [m], (36, 3): a bar of 9 by 2 by 2."""
    axes = (np.arange(COLUMNS), np.arange(ROWS), np.arange(ROWS))
    return SPACING_M * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


HELD = (np.arange(4), np.arange(32, 36))
"""Particles that each grip holds, the first and the last column; at rest they lie where its controllers are."""


def graph(holding: tuple[int, ...] | None = None) -> GraphSpec:
    """The bar's graph on the grips that hold."""
    rest = lattice()
    return build_graph(
        rest,
        rest,
        rest[np.concatenate(HELD)],
        dt_s=DT_S,
        config=SMALL,
        control_groups=GRIPS,
        holding=holding,
    )


@cache
def episodes(count: int, seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Arrays of ``count`` episodes. Do not change them: they are shared."""
    rng = np.random.default_rng(seed)
    rest = lattice()
    i, j = np.nonzero(np.triu(np.linalg.norm(rest[:, None] - rest[None], axis=2) < 1.8 * SPACING_M, 1))
    ends = np.zeros((len(i), len(rest)))  # of each spring: -1 and 1
    ends[np.arange(len(i)), i], ends[np.arange(len(i)), j] = -1.0, 1.0
    length = np.linalg.norm(ends @ rest, axis=1)
    opened, closed = rng.integers(8, 24, count), rng.integers(34, 46, count)
    rate, phase = rng.uniform(3.0, 6.0, (2, count, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, count, 3))
    swing = 0.012 * rng.normal(size=(2, count, 3))
    swing[1, :, 0] *= 0.2  # the hands hardly stretch the bar

    def moved(hand: int, t: float) -> np.ndarray:
        """How far a hand has moved since the start (count, 3)."""
        return swing[hand] * (np.sin(rate[hand] * t + phase[hand]) - np.sin(phase[hand]))

    step = DT_S / SUBSTEPS
    x = np.repeat(rest[:, None], count, axis=1)  # (36, count, 3)
    v = np.zeros_like(x)
    hold = x[
        HELD[1]
    ].copy()  # what the second grip moves, and how far its hand had moved when it took hold of it
    since = np.zeros((count, 3))
    path, driven = [x.copy()], [x[np.concatenate(HELD)].copy()]
    for frame in range(FRAMES - 1):
        holds = (frame < opened) | (frame >= closed)
        taken = frame == closed
        hold[:, taken], since[taken] = driven[-1][GRIPS[1]][:, taken], moved(1, frame * DT_S)[taken]
        for tick in range(1, SUBSTEPS + 1):
            t = frame * DT_S + tick * step
            along = np.tensordot(ends, x, axes=1)
            now = np.sqrt(np.einsum("sex,sex->se", along, along))[..., None]
            pull = STIFFNESS_S2 * (1.0 - length[:, None, None] / now) * along
            pull += DAMPING_S * np.tensordot(ends, v, axes=1)
            new = x + step * (v + step * (GRAVITY_M_S2 - np.tensordot(ends.T, pull, axes=1)))
            new[HELD[0]] = rest[HELD[0], None] + moved(0, t)
            new[HELD[1]] = np.where(holds[:, None], hold + moved(1, t) - since, new[HELD[1]])
            x, v = new, (new - x) / step
        path.append(x.copy())
        controllers = x[np.concatenate(HELD)].copy()
        turns, shifts = rigid_motion(rest[HELD[1]], x[HELD[1]].swapaxes(0, 1))
        carried = (rest[HELD[1]] @ turns.swapaxes(1, 2) + shifts[:, None]).swapaxes(0, 1)
        controllers[4:] = np.where(holds[:, None], controllers[4:], carried)
        driven.append(controllers)
    frames = np.minimum(np.arange(FRAMES), FRAMES - 2)[:, None]
    shut = ((frames < opened) | (frames >= closed)).astype(np.uint8)
    return [
        {
            "times": np.arange(FRAMES) * DT_S,
            "particles": np.array(path)[:, :, k].astype(np.float32),
            "controllers": np.array(driven)[:, :, k].astype(np.float32),
            "properties": np.zeros((len(rest), 2), dtype=np.float32),
            "holding": np.stack([np.ones(FRAMES, dtype=np.uint8), shut[:, k]], axis=1),
        }
        for k in range(count)
    ]
