"""3D Gaussians as the field stores them: means, scales, rotations, opacities, spherical harmonics (Kerbl et al. 2023).

The PLY layout is that of the reference implementation of "3D Gaussian Splatting for Real-Time Radiance Field
Rendering": per vertex ``x y z``, ``f_dc_0..2``, ``f_rest_*`` (channel by channel), ``opacity`` (logit),
``scale_0..2`` (log), ``rot_0..3`` (w, x, y, z, not normalised). ``nx ny nz`` may be there and mean nothing.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from plyfile import PlyData, PlyElement, PlyHeaderParseError, PlyParseError
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.errors import GaussiansUnreadable

SH_DC = 0.5 / np.sqrt(np.pi)
"""Y_00, the constant spherical harmonic: colour = 0.5 + SH_DC · coefficient."""

MOST_GAUSSIANS = 5_000_000
_COEFFICIENTS = {3: 1, 12: 4, 27: 9, 48: 16}  # numbers a Gaussian has for its colour: coefficients a channel
_LARGEST_LOG_SCALE = 10.0
_NEIGHBOUR_SHARE = (
    0.6  # of the mean distance to the three nearest points: spheres that just close the surface
)
_OPAQUE_LOGIT = 3.0


@dataclass(frozen=True)
class Gaussians:
    """G anisotropic Gaussians.

    Attributes:
        means: (G, 3) [m].
        log_scales: (G, 3), logarithms of the standard deviations along their own axes [log m].
        rotations: (G, 4) unit quaternions (w, x, y, z), own axes to the world's.
        opacity_logits: (G,).
        harmonics: (G, C, 3) with C = 1, 4, 9 or 16 coefficients a colour channel.
    """

    means: Array
    log_scales: Array
    rotations: Array
    opacity_logits: Array
    harmonics: Array

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Array:
        """(G,) in (0, 1)."""
        return 1.0 / (1.0 + np.exp(-self.opacity_logits))


def from_ply(content: bytes) -> Gaussians:
    """Read a splat.

    Raises:
        GaussiansUnreadable: no PLY, cut off, not of that layout, empty, more than ``MOST_GAUSSIANS``, or a number that
            is not finite; the message says which.
    """
    try:
        table = PlyData.read(io.BytesIO(content))
        vertex = table["vertex"]
        count = vertex.count
        names = {p.name for p in vertex.properties}
    except (
        PlyHeaderParseError,
        PlyParseError,
        KeyError,
        ValueError,
        UnicodeDecodeError,
        MemoryError,
    ) as error:
        raise GaussiansUnreadable(f"not a PLY file of Gaussians ({len(content)} bytes): {error}") from error
    if not 0 < count <= MOST_GAUSSIANS:
        raise GaussiansUnreadable(f"{count} Gaussians; there must be 1 to {MOST_GAUSSIANS}")
    wanted = [
        "x",
        "y",
        "z",
        "opacity",
        *_numbered("f_dc_", 3),
        *_numbered("scale_", 3),
        *_numbered("rot_", 4),
    ]
    missing = sorted(set(wanted) - names)
    if missing:
        raise GaussiansUnreadable(
            f"the PLY's vertices lack {', '.join(missing)}: a point cloud, not a splat?"
        )
    rest = _numbered("f_rest_", len({n for n in names if n.startswith("f_rest_")}))
    if len(rest) + 3 not in _COEFFICIENTS or not set(rest) <= names:
        raise GaussiansUnreadable(f"{len(rest)} properties f_rest_*; there must be 0, 9, 24 or 45")

    def columns(*keys: str) -> Array:
        return np.stack([np.asarray(vertex[key], dtype=np.float64) for key in keys], axis=1)

    values = columns(*wanted)
    further = columns(*rest) if rest else np.zeros((count, 0))
    bad = ~(np.isfinite(values).all(axis=1) & np.isfinite(further).all(axis=1))
    if bad.any():
        raise GaussiansUnreadable(f"{bad.sum()} of {count} Gaussians hold numbers that are not finite")
    rotations, scales = values[:, 10:14], values[:, 7:10]
    length = np.linalg.norm(rotations, axis=1)
    if (
        (length < 1e-12).any()
        or (np.abs(scales) > _LARGEST_LOG_SCALE + 20).any()
        or scales.max() > _LARGEST_LOG_SCALE
    ):
        raise GaussiansUnreadable(
            f"{(length < 1e-12).sum()} rotations of length 0, log scales from {scales.min():.3g} to {scales.max():.3g} "
            f"(at most {_LARGEST_LOG_SCALE:g})"
        )
    coefficients = _COEFFICIENTS[len(rest) + 3]
    harmonics = np.concatenate(
        [values[:, None, 4:7], further.reshape(count, 3, coefficients - 1).transpose(0, 2, 1)], axis=1
    )
    return Gaussians(values[:, :3], scales, rotations / length[:, None], values[:, 3], harmonics)


def to_ply(gaussians: Gaussians) -> bytes:
    """The splat as a little-endian PLY in single precision."""
    rest = gaussians.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), -1)
    named = {
        **dict(zip("xyz", gaussians.means.T, strict=True)),
        **dict(zip(_numbered("f_dc_", 3), gaussians.harmonics[:, 0].T, strict=True)),
        **dict(zip(_numbered("f_rest_", rest.shape[1]), rest.T, strict=True)),
        "opacity": gaussians.opacity_logits,
        **dict(zip(_numbered("scale_", 3), gaussians.log_scales.T, strict=True)),
        **dict(zip(_numbered("rot_", 4), gaussians.rotations.T, strict=True)),
    }
    table = np.empty(len(gaussians), dtype=[(name, "<f4") for name in named])
    for name, column in named.items():
        table[name] = column
    buffer = io.BytesIO()
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(buffer)
    return buffer.getvalue()


def gaussians_at_points(points: Array, colours: Array | None = None) -> Gaussians:
    """A plain splat where no photographs are: one sphere a point, as large as the distance to its neighbours.

    Args:
        points: (P, 3) [m].
        colours: (P, 3) in [0, 1]; by default by the points' places along the cloud's principal axes.

    Raises:
        GaussiansUnreadable: no points, or places that are not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise GaussiansUnreadable(f"points must be finite and of shape (P, 3), got {points.shape}")
    if colours is None:
        centred = points - points.mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
        span = np.ptp(along, axis=0)
        colours = 0.15 + 0.7 * (along - along.min(axis=0)) / np.where(span > 0, span, 1.0)
    count = min(4, len(points))
    if count > 1:
        distance = cKDTree(points).query(points, k=count)[0][:, 1:].mean(axis=1)
        distance = np.maximum(distance, 1e-6)
    else:
        distance = np.full(1, 0.01)
    scale = np.log(_NEIGHBOUR_SHARE * distance)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    return Gaussians(
        points,
        np.repeat(scale[:, None], 3, axis=1),
        identity,
        np.full(len(points), _OPAQUE_LOGIT),
        ((np.asarray(colours, dtype=np.float64) - 0.5) / SH_DC)[:, None],
    )


def _numbered(stem: str, count: int) -> list[str]:
    return [f"{stem}{k}" for k in range(count)]
