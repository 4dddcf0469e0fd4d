"""Model discrepancy: what a twin leaves although nothing is missing in it, as a part of the covariance.

    r ~ N(0, I + kappa^2 K)        r: residual, whitened by noise, points' places and the solver's own error

No twin of a real object is right to the last micrometre of a camera. What it leaves is smooth: in time on the scale
of the motion, along the body on the scale of its length (Kennedy and O'Hagan 2001; Brynjarsdottir and O'Hagan 2014).
K is the product of a Matern kernel of order 3/2 over time and a squared exponential over the points' places at rest,
alike in x, y and z and independent from one block of frames to the next; its amplitude kappa [m] is what is
assumed of a twin. Without any, r is white.

Within a block K has few directions that matter (U, with factors s), so that every kappa costs a few products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.estimation.whitening import Whitener

_BODY_SHARE = 0.5  # length scale along the body over its size
_KEPT = 0.99  # of each kernel's variance
_MOST_SHAPES, _MOST_TIMES = 6, 12


@dataclass(frozen=True)
class Block:
    """Rows of one block of frames, and the directions of K there: ``basis`` (m, r), orthonormal, ``factors`` (r,).

    ``factors`` are standard deviations over the noise of a discrepancy of 1 m.
    """

    rows: Array
    basis: Array
    factors: Array


@dataclass(frozen=True)
class Discrepancy:
    """K of one recording, or of several side by side.

    Attributes:
        blocks: of frames.
        sigma: noise [m].
        time_s: scale of its kernel over time [s].
    """

    blocks: tuple[Block, ...]
    sigma: float
    time_s: float

    def shrink(self, block: Block, kappa: float) -> Array:
        """What whitening takes from every direction of a block, (r,)."""
        taken: Array = 1.0 - 1.0 / np.sqrt(1.0 + (kappa * block.factors) ** 2)
        return taken

    def whitened(self, values: Array, kappa: float) -> Array:
        """(I + kappa^2 K)^(-1/2) times ``values`` (M,) or (M, p)."""
        out = values.copy()
        for block in self.blocks if kappa > 0 else ():
            inner = block.basis.T @ values[block.rows]
            out[block.rows] -= block.basis @ (_down(self.shrink(block, kappa), inner) * inner)
        return out


def discrepancy_of(
    white: Whitener, split: Split, times: Array, places: Array, owners: Array, motion: Array
) -> Discrepancy:
    """The discrepancy of a recording.

    Args:
        white: whitener of its training frames.
        split: its training frames in blocks.
        times: of the frames [s], (T,).
        places: of the tracked points at rest [m], (N, 3).
        owners: recording of every tracked point, (N,); recordings err independently of each other.
        motion: tracks that tell how fast the body moves, (frames, N, 3) [m].
    """
    scale = _time_scale(motion, times)
    many = len(np.unique(owners))
    shapes = _factors(_squared_exponential(places, owners, _BODY_SHARE), _MOST_SHAPES * many)
    frames, block_of_row = white.frame_of_row, split.block_of(white.frame_of_row)
    points = np.repeat(white.points, 3)
    along = [white.along(axis) for axis in range(3)]
    count = len(white.visible) + white.first
    blocks = []
    for number in range(split.blocks):
        rows = np.flatnonzero(block_of_row == number)
        if not len(rows):
            continue
        own = np.arange(split.edges[number], split.edges[number + 1])
        courses = np.zeros((count, min(len(own), _MOST_TIMES)))
        some = _factors(_matern(times[own], scale), courses.shape[1])
        courses = courses[:, : some.shape[1]]
        courses[own] = some
        product = courses[frames[rows]][:, :, None] * shapes[points[rows]][:, None, :]
        product = product.reshape(len(rows), -1) / white.sigma
        columns = np.concatenate([product * part[rows][:, None] for part in along], axis=1)
        columns = _through(white, rows, columns)
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        kept = s > 1e-6 * max(float(s.max(initial=0.0)), 1e-300)
        blocks.append(Block(rows, u[:, kept], s[kept]))
    return Discrepancy(tuple(blocks), white.sigma, scale)


def _through(white: Whitener, rows: Array, columns: Array) -> Array:
    """Columns (m, k) of some rows as the whitener leaves them in these rows."""
    out = columns.copy()
    place_of_row = np.full(3 * len(white.measured), -1)
    place_of_row[rows] = np.arange(len(rows))
    for place in white.places:
        own = (3 * place.rows[:, None] + np.arange(3)).reshape(-1)
        here = place_of_row[own]
        inside = here >= 0
        if inside.any():
            basis = place.basis[inside]
            out[here[inside]] -= basis @ (place.shrink[:, None] * (basis.T @ columns[here[inside]]))
    if white.common is not None:
        basis, shrink = white.common
        out -= basis[rows] @ (shrink[:, None] * (basis[rows].T @ out))
    return out


def _down(scale: Array, values: Array) -> Array:
    """``scale`` (r,) in the shape that multiplies the rows of ``values`` (r,) or (r, p)."""
    return scale if values.ndim == 1 else scale[:, None]


def _time_scale(motion: Array, times: Array) -> float:
    """Deviation of the motion over that of its velocity [s]: 1 / omega of a body that swings."""
    velocity = np.gradient(motion, times[: len(motion)], axis=0)
    size = float(np.sqrt(np.mean((motion - motion.mean(axis=0)) ** 2)))
    speed = float(np.sqrt(np.mean(velocity**2)))
    step = float(np.median(np.diff(times)))
    return float(np.clip(size / max(speed, 1e-300), 2.0 * step, max(float(times[-1] - times[0]), 2.0 * step)))


def _matern(times: Array, scale: float) -> Array:
    apart = np.sqrt(3.0) * np.abs(times[:, None] - times[None, :]) / scale
    kernel: Array = (1.0 + apart) * np.exp(-apart)
    return kernel


def _squared_exponential(places: Array, owners: Array, share: float) -> Array:
    sizes = [np.ptp(places[owners == owner], axis=0).max() for owner in np.unique(owners)]
    scale = share * max(float(max(sizes)), 1e-12)
    apart = np.sum((places[:, None, :] - places[None, :, :]) ** 2, axis=2)
    kernel: Array = np.exp(-0.5 * apart / scale**2) * (owners[:, None] == owners[None, :])
    return kernel


def _factors(kernel: Array, most: int) -> Array:
    """The leading factors F (n, r) of a kernel, F F^T nearly the kernel."""
    values, vectors = np.linalg.eigh(kernel)
    values, vectors = values[::-1], vectors[:, ::-1]
    enough = int(np.searchsorted(np.cumsum(values) / values.sum(), _KEPT)) + 1
    kept = min(enough, most, len(values))
    factors: Array = vectors[:, :kept] * np.sqrt(np.maximum(values[:kept], 0.0))
    return factors
