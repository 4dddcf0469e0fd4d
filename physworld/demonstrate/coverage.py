"""What a set of episodes covers: motions, properties, the workspace, and what was rejected on the way.

A :class:`Coverage` takes the episodes one by one and keeps counts, histograms and a thinned cloud of places, so that
thousands of episodes fit in memory. ``summary`` is plain JSON; the arrays that pictures need stay attributes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from physworld.arrays import Array

MOST_PLACES = 200_000
PLACES_PER_EPISODE = 1500
MOST_REJECTIONS = 200
VOXELS = 24  # along the longest side of the workspace
PERCENTILES = (0, 5, 50, 95, 100)


class Coverage:
    """Accumulates episodes; ``expected`` of them decide how densely places are kept.

    Attributes:
        motions: episodes by pattern.
        rows: one dict of figures an episode (speeds, reach, means and spreads of log properties).
        places: thinned particle positions [m], list of (n, 3) float32.
        speeds: control point speeds at the ticks [m/s], list of (n,).
        log_modulus: thinned log(E/E_fit), list of (n,).
        rejections: what was rejected, with the episode's index.
    """

    def __init__(self, expected: int) -> None:
        self._places_each = int(np.clip(MOST_PLACES // max(expected, 1), 20, PLACES_PER_EPISODE))
        self.motions: Counter[str] = Counter()
        self.rows: list[dict[str, float | str]] = []
        self.places: list[Array] = []
        self.speeds: list[Array] = []
        self.log_modulus: list[Array] = []
        self.rejections: list[dict[str, Any]] = []
        self._strengths: dict[str, list[float]] = {}

    def add(self, arrays: Mapping[str, Array], attributes: Mapping[str, Any]) -> None:
        """Count one episode: its stored arrays and attributes."""
        particles, controllers = arrays["particles"], arrays["controllers"].astype(np.float64)
        properties, times = arrays["properties"].astype(np.float64), arrays["times"]
        speeds = np.linalg.norm(np.diff(controllers, axis=0), axis=-1) / np.diff(times)[:, None]
        reach = np.linalg.norm(controllers - controllers[:1], axis=-1)
        moved = np.linalg.norm(particles[-1] - particles[0], axis=-1)
        frames, count, _ = particles.shape
        step = max(1, (frames * count) // self._places_each)
        flat = particles.reshape(-1, 3)
        self.places.append(flat[len(self.rows) % step :: step].copy())
        self.speeds.append(speeds.max(axis=1, initial=0.0).astype(np.float32))
        thin = max(1, count // 50)
        self.log_modulus.append(properties[::thin, 0].astype(np.float32))
        motion = str(attributes.get("motion", ""))
        self.motions[motion] += 1
        self.rows.append(
            {
                "motion": motion,
                "peak_speed_m_s": float(speeds.max(initial=0.0)),
                "reach_m": float(reach.max(initial=0.0)),
                "end_displacement_m": float(moved.mean()),
                "log_modulus_mean": float(properties[:, 0].mean()),
                "log_modulus_std": float(properties[:, 0].std()),
                "log_density_mean": float(properties[:, 1].mean()),
                "log_density_std": float(properties[:, 1].std()),
                "ground_friction": float(attributes.get("parameters", {}).get("ground_friction", np.nan)),
                "log_friction_mean": _of_column(properties, 2, np.mean),
                "log_friction_std": _of_column(properties, 2, np.std),
            }
        )
        for name, value in attributes.get("effect_strengths", {}).items():
            self._strengths.setdefault(name, []).append(float(value))
        for one in attributes.get("rejected", []):
            self.rejections.append({"episode": attributes.get("index", len(self.rows) - 1), **one})

    def column(self, name: str) -> Array:
        """One figure of every episode, (episodes,)."""
        return np.array([row[name] for row in self.rows], dtype=np.float64)

    def summary(self) -> dict[str, Any]:
        """Counts and percentiles; JSON types only."""
        places = np.concatenate(self.places)
        columns = {name: self.column(name) for name in self.rows[0] if name != "motion"}
        figures = {
            name: _percentiles(values[np.isfinite(values)])
            for name, values in columns.items()
            if np.isfinite(values).any()
        }
        kinds = Counter(str(one.get("kind", "")) for one in self.rejections)
        tried = Counter(self.motions)
        tried.update(str(one.get("motion", "")) for one in self.rejections)
        return {
            "episodes": len(self.rows),
            "motions": dict(sorted(self.motions.items())),
            "figures": figures,
            "log_modulus": _percentiles(np.concatenate(self.log_modulus)),
            "effect_strengths": {
                name: _percentiles(np.array(v)) for name, v in sorted(self._strengths.items())
            },
            "workspace": workspace(places),
            "rejections": {
                "count": len(self.rejections),
                "share_of_tries": len(self.rejections) / (len(self.rejections) + len(self.rows)),
                "by_kind": dict(kinds.most_common()),
                "by_motion": {
                    motion: {"rejected": count - self.motions[motion], "tries": count}
                    for motion, count in sorted(tried.items())
                },
                "first": self.rejections[:MOST_REJECTIONS],
            },
        }


def workspace(places: Array) -> dict[str, Any]:
    """Box of places (n, 3) [m] and the share of its voxels that are visited."""
    low, high = places.min(axis=0).astype(float), places.max(axis=0).astype(float)
    voxel = max(float((high - low).max()) / VOXELS, 1e-9)
    cells = np.unique(((places - low) / voxel).astype(np.int64), axis=0)
    inside = int(np.prod(np.floor((high - low) / voxel).astype(np.int64) + 1))
    return {
        "min_m": low.tolist(),
        "max_m": high.tolist(),
        "voxel_m": voxel,
        "voxels_visited": len(cells),
        "occupancy": len(cells) / inside,
    }


def _of_column(values: Array, column: int, figure: Callable[[Array], Any]) -> float:
    """A figure of a column of (P, ·), no number where there is no such column."""
    return float(figure(values[:, column])) if values.shape[1] > column else float("nan")


def _percentiles(values: Array) -> dict[str, float]:
    """Minimum, 5th, median, 95th, maximum."""
    found = np.percentile(np.asarray(values, dtype=np.float64), PERCENTILES)
    return {f"p{p}": float(v) for p, v in zip(PERCENTILES, found, strict=True)}
