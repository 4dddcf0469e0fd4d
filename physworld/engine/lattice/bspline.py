"""Uniform quadratic B-splines on unit cells, and the Gauss points that carry the material.

Cell c spans [c, c + 1]; node i sits at the cell's middle i + 1/2 and is supported on the cells i - 1 to i + 1, so a
cell sees 3 nodes an axis and 3**d in d dimensions. The basis is C1: it holds solids as well as the bending energies
of rods and sheets, which need second derivatives. Coordinates here are in units of the cell, xi in [0, 1].

Particles sit on the two Gauss points of every axis (2**d a cell), about dx/2 apart: the lattice that integrates a
bending profile exactly even where one cell spans the whole thickness.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from physworld.arrays import Array

GAUSS_POINTS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


def axis_values(xi: Array) -> Array:
    """Values of the 3 functions of a cell at local coordinates ``xi`` (M,): shape (M, 3)."""
    return np.stack([0.5 * (1 - xi) ** 2, 0.5 + xi - xi**2, 0.5 * xi**2], axis=-1)


def axis_slopes(xi: Array) -> Array:
    """First derivatives with respect to ``xi`` (M,): shape (M, 3)."""
    return np.stack([xi - 1, 1 - 2 * xi, xi], axis=-1)


def axis_curvatures(xi: Array) -> Array:
    """Second derivatives with respect to ``xi`` (M,): shape (M, 3)."""
    return np.broadcast_to(np.array([1.0, -2.0, 1.0]), (*xi.shape, 3)).copy()


_AXIS = (axis_values, axis_slopes, axis_curvatures)


def tensor_weights(xi: Array, orders: tuple[int, ...]) -> Array:
    """Tensor-product weights at local coordinates, differentiated ``orders[a]`` times along axis a.

    Args:
        xi: local coordinates, (M, d).
        orders: derivative order (0, 1 or 2) of every axis, d of them.

    Returns:
        (M, 3**d), the last axis of the lattice running fastest.
    """
    weights = np.ones((xi.shape[0], 1))
    for axis, order in enumerate(orders):
        factor = _AXIS[order](xi[:, axis])
        weights = (weights[:, :, None] * factor[:, None, :]).reshape(xi.shape[0], -1)
    return weights


def gauss_points(dim: int) -> Array:
    """Local coordinates of a cell's 2**dim particles, (2**dim, dim)."""
    return np.array(list(product(GAUSS_POINTS, repeat=dim)))


def local_offsets(dim: int) -> Array:
    """Node offsets (-1, 0, 1 an axis) of a cell, (3**dim, dim), in the order of :func:`tensor_weights`."""
    return np.array(list(product((-1, 0, 1), repeat=dim)))
