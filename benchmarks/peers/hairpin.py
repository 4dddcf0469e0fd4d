"""A hairpin of masses and springs whose two arms are pressed together and repel each other: a body that touches itself.

Independent of our engine; a toy for what a world model sees of contact. Both ends are gripped and driven towards each
other and back; neighbours at rest are joined by damped springs, masses of different arms push each other away where
they come closer than ``REACH`` spacings.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

SPACING_M, COLUMNS, RISE = 0.02, 10, 5
DT_S, SUBSTEPS, FRAMES = 1.0 / 30.0, 60, 50
STIFFNESS, DAMPING, DRAG_PER_S = 8000.0, 30.0, 1.0  # per mass
REPULSION, REACH, BOND = 20000.0, 1.3, 1.8


def rest_places() -> np.ndarray:
    """Masses at rest [m], (P, 3): two arms along x, 2 by 2 in section, joined at their far end."""
    low = np.array([(i, j, k) for i in range(COLUMNS) for j in range(2) for k in range(2)], dtype=float)
    bend = [(i, j, k) for i in (COLUMNS - 2, COLUMNS - 1) for j in range(2) for k in range(2, RISE)]
    return SPACING_M * np.concatenate([low, low + np.array([0.0, 0.0, RISE]), np.array(bend, dtype=float)])


def grips(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masses that each grip holds: the free ends of the arms."""
    ends = rest[:, 0] < 0.5 * SPACING_M
    upper = rest[:, 2] > 2.5 * SPACING_M
    return np.nonzero(ends & ~upper)[0], np.nonzero(ends & upper)[0]


def episode(seed: int) -> tuple[dict[str, np.ndarray], float]:
    """Arrays of one episode, as a dataset stores them, and the share of its frames in which the arms touch."""
    rng = np.random.default_rng(seed)
    rest = rest_places()
    held = grips(rest)
    apart = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    first, second = np.nonzero(np.triu(apart < BOND * SPACING_M, 1))
    one, other = np.nonzero(np.triu(apart >= BOND * SPACING_M, 1))
    bonds, strangers = _differences(first, second, len(rest)), _differences(one, other, len(rest))
    length, reach = apart[first, second], REACH * SPACING_M
    log_stiffness = rng.normal(0.0, 0.2)
    stiffness = STIFFNESS * np.exp(log_stiffness)
    rate, press = rng.uniform(2.5, 5.0), rng.uniform(1.2, 2.6) * SPACING_M
    aside = 0.3 * SPACING_M * rng.normal(size=3)
    step, touching = DT_S / SUBSTEPS, 0
    x, v, path = rest.copy(), np.zeros_like(rest), [rest.copy()]
    for tick in range(1, (FRAMES - 1) * SUBSTEPS + 1):
        along = bonds @ x
        now = np.linalg.norm(along, axis=1)
        unit = along / now[:, None]
        pull = stiffness * (now - length) + DAMPING * ((bonds @ v) * unit).sum(axis=1)
        force = -(bonds.T @ (pull[:, None] * unit))
        gap = strangers @ x
        close = np.sqrt(np.einsum("ij,ij->i", gap, gap))
        if close.min() < reach:
            push = np.where(close < reach, REPULSION * (reach / close - 1.0), 0.0)
            force += strangers.T @ (push[:, None] * gap)
        v = v + step * (force - DRAG_PER_S * v)
        x = x + step * v
        share = np.sin(rate * tick * step) ** 2
        for places, sign in zip(held, (1.0, -1.0), strict=True):
            x[places] = rest[places] + share * (np.array([0.0, 0.0, sign * press]) + aside)
            v[places] = 0.0
        if tick % SUBSTEPS == 0:
            path.append(x.copy())
            touching += close.min() < reach
    particles = np.array(path)
    properties = np.zeros((len(rest), 2))
    properties[:, 0] = log_stiffness
    arrays = {
        "times": np.arange(FRAMES) * DT_S,
        "particles": particles.astype(np.float32),
        "controllers": particles[:, np.concatenate(held)].astype(np.float32),
        "properties": properties.astype(np.float32),
    }
    return arrays, touching / FRAMES


def _differences(first: np.ndarray, second: np.ndarray, count: int) -> csr_array:
    """(M, P) that takes x_second - x_first of every pair."""
    rows = np.tile(np.arange(len(first)), 2)
    signs = np.repeat([-1.0, 1.0], len(first))
    return csr_array((signs, (rows, np.concatenate([first, second]))), shape=(len(first), count))
