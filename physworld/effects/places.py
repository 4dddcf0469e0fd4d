"""Where on a twin an effect acts: scales, ends, regions and material coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


def body_size(twin: Twin) -> float:
    """Largest extent of the body at the start [m]."""
    return float(np.ptp(twin.particles_start, axis=0).max())


def gravity_size(twin: Twin) -> float:
    """Strength of gravity [m/s^2]; 9.81 where there is none, as a scale of forces."""
    size = float(np.linalg.norm(twin.gravity_m_s2))
    return size if size > 1e-6 else 9.81


def free_end(twin: Twin) -> Array:
    """Start of the material that lies farthest from what is held [m], (3,); of nothing is held, from the middle."""
    particles = twin.particles_start[twin.particle_mass > 0]
    farthest: Array = particles[int(np.argmax(_from_held(twin, particles)))]
    return farthest


def middle_of_free_end(twin: Twin) -> Array:
    """Centre of the particles that lie as far from what is held as :func:`free_end` within half a cell [m], (3,).

    Where those are ends apart, with their centre less than half as far, it is :func:`free_end` alone.
    """
    places = twin.particles_start[twin.particle_mass > 0]
    gap = _from_held(twin, places)
    middle = places[gap >= gap.max() - 0.5 * float(twin.lattice.spacing.max())].mean(axis=0)
    return middle if _from_held(twin, middle[None])[0] >= 0.5 * gap.max() else free_end(twin)


def _from_held(twin: Twin, places: Array) -> Array:
    """Distance of places (P, 3) from what is held, or from the body's middle, (P,) [m]."""
    held = np.concatenate([np.empty(0, dtype=int), *twin.held_nodes]).astype(int)
    middle = twin.particles_start[twin.particle_mass > 0].mean(axis=0, keepdims=True)
    known = twin.body.start[held] if len(held) else middle
    gaps: Array = np.linalg.norm(places[:, None] - known[None], axis=2).min(axis=1)
    return gaps


def region_weights(twin: Twin, centre: Array, radius: float) -> tuple[Array, Array]:
    """Nodes (k,) and weights (k,), summing to 1, of the centroid of the material that :func:`region_shares` names."""
    rows = twin.lattice.interpolation(twin.lattice.particle_coordinates)
    weights = np.asarray(rows.T @ region_shares(twin, centre, radius))
    nodes = np.nonzero(weights)[0]
    return nodes, weights[nodes]


def region_shares(twin: Twin, centre: Array, radius: float) -> Array:
    """Shares of the particles, (P,), summing to 1, in the centroid of the material within ``radius`` [m] of ``centre``.

    Places are those of the start; where nothing lies so near, the nearest particle is the region.
    """
    gap = np.linalg.norm(twin.particles_start - centre, axis=1)
    mass = twin.particle_mass
    inside = (gap <= radius) & (mass > 0)
    if not inside.any():
        inside = np.arange(len(gap)) == int(np.argmin(np.where(mass > 0, gap, np.inf)))
    shares: Array = np.where(inside, mass, 0.0) / mass[inside].sum()
    return shares


def unit_coordinates(lattice: Lattice) -> Array:
    """Material coordinates of the particles, -1 to 1 over the body along every axis, (P, d)."""
    places = lattice.particle_coordinates
    filled = places[lattice.particle_measures > 0]
    low, high = filled.min(axis=0), filled.max(axis=0)
    unit: Array = (places - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-12)
    return unit


def held_count(twin: Twin) -> int:
    """Nodes that are held."""
    return sum(len(nodes) for nodes in twin.held_nodes)
