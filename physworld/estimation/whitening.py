"""Whitened residuals: what is known to be wrong without any effect is taken out by its covariance.

The covariance of measured minus predicted is sigma^2 (I + G G^T): sigma the tracking noise; G the response of a tracked
point to its own place in the body, which frame 0 gives with the same noise (a rigid body shows it as a shift that turns
with it). Where a scene declares a covariance for every point, all of this holds after its factor is divided out
(:meth:`physworld.scene.Scene.weighed`). Beside a model's own error of (e - 1) sigma^2 in every sighting it is sigma^2
(e I + G G^T), whitened as I + G G^T / e (:meth:`Whitener.beside`). W with W^T W the inverse is applied to residuals and
to sensitivities alike, so that ordinary least squares of whitened quantities is the generalised one. G acts point by
point, so thin factors do.

A rope or a sheet that is declared undeformed lies along the line or in the plane of its first points. Their noise
turns it as a whole: a rope of nine markers by about sigma / (2 L), and then it swings as under a tilted gravity. Turns
about the body's axes through its grips (:func:`turned_starts`) are taken out of every residual by their covariance too
(:meth:`Whitener.knowing`). Bodies from facts without noise (``rest_volume_points``, a box) have none; of starts that
are fitted to several frames it is not known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.twin import Twin

_LEAST_LEVER = 0.05  # of the body's size: points nearer to an axis than this say nothing of a turn about it
_SHIFT_M = 1e-4  # of a tracked point, to see how its track answers


@dataclass(frozen=True)
class Place:
    """A tracked point's own place: its sightings (k,), and the thin factors of its part of the covariance.

    ``response`` (3k, r) is G, ``basis`` (3k, r) spans it, ``shrink`` (r,) is what whitening takes from each direction.
    """

    rows: Array
    response: Array
    basis: Array
    shrink: Array


class Whitening(Protocol):
    """What a fit asks of a whitener."""

    @property
    def measured(self) -> Array:
        """Sightings, (V, 3) [m]."""

    def residual(self, tracks: Array) -> Array:
        """Whitened measured minus predicted, (M,), of tracks (frames, N, 3)."""

    def change(self, difference: Array) -> Array:
        """Whitened change of a prediction, (M,)."""


@dataclass(frozen=True)
class Whitener:
    """See the module's text. M = 3 x number of sightings V in the training frames, in the order of ``visible``.

    Attributes:
        measured: (V, 3) [m].
        visible: of the training frames, (T, N) bool.
        frames: of every sighting, (V,).
        points: tracked point of every sighting, (V,).
        sigma: [m].
        first: first of the training frames.
        places: one a tracked point.
        common: what all points share of an uncertain start: basis (M, k) and shrink (k,), after the places; or None.
        weights: of every tracked point, (N, 3, 3): inverse factor of its covariance over sigma^2; None: the same noise
            along every axis.
        spreads: of every tracked point's own place along its material axes for a deviation of each of its noises,
            (N, 3, 3), over sigma; None as above.
    """

    measured: Array
    visible: Array
    frames: Array
    points: Array
    sigma: float
    first: int
    places: tuple[Place, ...]
    common: tuple[Array, Array] | None = None
    weights: Array | None = None
    spreads: Array | None = None

    def residual(self, tracks: Array) -> Array:
        """Whitened measured minus predicted, (M,), of tracks (frames, N, 3) from frame 0."""
        return self._whiten(self._weighed(self.measured - self._seen(tracks)) / self.sigma)

    def change(self, difference: Array) -> Array:
        """Whitened change of a prediction, (M,), of a difference of tracks (frames, N, 3)."""
        return self._whiten(self._weighed(self._seen(difference)) / self.sigma)

    def over_from(self, other: Whitener, columns: Array) -> Array:
        """Columns (M, p) that another whitener of the same sightings has whitened, by this one."""
        if not columns.shape[1]:
            return columns
        plain = [other._coloured(column) for column in columns.T]
        return np.stack([self._whiten(column.reshape(-1, 3)) for column in plain], axis=1)

    @property
    def frame_of_row(self) -> Array:
        """Frame of every row, (M,)."""
        return np.repeat(self.frames, 3)

    def place_errors(self, tracks: Array) -> Array:
        """Most probable error of every point's own place [m], (N, r), given a prediction; within three sigma."""
        error = self._weighed(self.measured - self._seen(tracks)) / self.sigma
        found = []
        for place in self.places:
            normal = place.response.T @ place.response + np.eye(place.response.shape[1])
            found.append(np.linalg.solve(normal, place.response.T @ error[place.rows].reshape(-1)))
        errors: Array = np.clip(np.array(found), -3.0, 3.0) * self.sigma
        return errors if self.spreads is None else np.einsum("nij,nj->ni", self.spreads, errors)

    def along(self, axis: int) -> Array:
        """What a unit along a world axis is in every row before places are taken out, (M,)."""
        unit = np.zeros((len(self.measured), 3))
        unit[:, axis] = 1.0
        return self._weighed(unit).reshape(-1)

    def until(self, end: int) -> Whitener:
        """Of the sightings before frame ``end``, by their noise alone."""
        kept = self.frames < end
        return replace(
            self,
            measured=self.measured[kept],
            visible=self.visible[: end - self.first],
            frames=self.frames[kept],
            points=self.points[kept],
            places=(),
            common=None,
        )

    def _weighed(self, values: Array) -> Array:
        """Of sightings (V, 3)."""
        if self.weights is None:
            return values
        weighed: Array = np.einsum("vij,vj->vi", self.weights[self.points], values)
        return weighed

    def _seen(self, tracks: Array) -> Array:
        return tracks[self.first : self.first + len(self.visible)][self.visible]

    def _whiten(self, values: Array) -> Array:
        out = values.copy()
        for place in self.places:
            block = out[place.rows].reshape(-1)
            out[place.rows] = (block - place.basis @ (place.shrink * (place.basis.T @ block))).reshape(-1, 3)
        flat: Array = out.reshape(-1)
        if self.common is not None:
            basis, shrink = self.common
            flat = flat - basis @ (shrink * (basis.T @ flat))
        return flat

    def _coloured(self, flat: Array) -> Array:
        """What is whitened to ``flat`` (M,), (V, 3)."""
        if self.common is not None:
            basis, shrink = self.common
            flat = flat + basis @ (shrink / (1.0 - shrink) * (basis.T @ flat))
        out: Array = flat.reshape(-1, 3).copy()
        for place in self.places:
            block = out[place.rows].reshape(-1)
            grown = place.shrink / (1.0 - place.shrink) * (place.basis.T @ block)
            out[place.rows] = (block + place.basis @ grown).reshape(-1, 3)
        return out

    def knowing(self, differences: list[Array], error: float = 1.0) -> Whitener:
        """With changes of the prediction, (frames, N, 3) each, that are as likely as not: one deviation each.

        Args:
            differences: the changes.
            error: see :meth:`beside`, by which the places have been taken already.
        """
        if not differences:
            return self
        factors = np.stack([self.change(difference) for difference in differences], axis=1)
        u, s, _ = np.linalg.svd(factors, full_matrices=False)
        return replace(self, common=(u, _shrink(s / np.sqrt(error))))

    def beside(self, error: float) -> Whitener:
        """Beside an error of the model in every sighting, I + G G^T / error: places are no less certain for it, and are
        not blamed for what is larger than they are.

        Args:
            error: mean squared residual over the noise's, 1 for a perfect model.
        """
        places = (
            replace(place, shrink=_shrink(np.sqrt(((1.0 - place.shrink) ** -2 - 1.0) / error)))
            for place in self.places
        )
        return replace(self, places=tuple(places))


def _shrink(s: Array) -> Array:
    """What whitening takes from directions along which the covariance is 1 + s^2."""
    taken: Array = 1.0 - 1.0 / np.sqrt(1.0 + s**2)
    return taken


@dataclass(frozen=True)
class ScaledWhitener:
    """Whitens as ``base`` does, and divides by ``scale``, deviations of the noise that a sighting counts as."""

    base: Whitener
    scale: float

    @property
    def measured(self) -> Array:
        """Sightings, (V, 3) [m]."""
        return self.base.measured

    def residual(self, tracks: Array) -> Array:
        """Whitened measured minus predicted, (M,), of tracks (frames, N, 3)."""
        return self.base.residual(tracks) / self.scale

    def change(self, difference: Array) -> Array:
        """Whitened change of a prediction, (M,), of a difference of tracks (frames, N, 3)."""
        return self.base.change(difference) / self.scale


def whitener(scene: Scene, split: Split, sigma: float, responses: Array) -> Whitener:
    """The whitener of the training frames; a point that frame 0 does not show has no place of its own and is left out.

    Where frame 0 shows none, all are kept.

    Args:
        scene, split: what was measured, and which of it counts.
        sigma: tracking noise [m].
        responses: of every tracked point to its own place, (frames, N, 3, r), from :func:`responses`.
    """
    first, end = split.train
    placed = scene.visible[0] if scene.visible[0].any() else np.ones(scene.visible.shape[1], dtype=bool)
    visible = scene.visible[first:end] & placed
    frames, points = np.nonzero(visible)
    weights = spreads = None
    if (factors := scene.noise_factors) is not None:  # a place is as uncertain as its sighting in frame 0
        weights = np.linalg.inv(factors)
        spreads = np.linalg.pinv(responses[0]) @ factors
        responses = weights @ responses @ spreads
    places = []
    for point in range(visible.shape[1]):
        rows = np.nonzero(points == point)[0]
        response = responses[first:end][visible[:, point], point].reshape(3 * len(rows), responses.shape[-1])
        u, s, _ = np.linalg.svd(response, full_matrices=False)
        places.append(Place(rows, response, u, _shrink(s)))
    measured = scene.points[first:end][visible]
    return Whitener(
        measured,
        visible,
        frames + first,
        points,
        sigma,
        first,
        tuple(places),
        weights=weights,
        spreads=spreads,
    )


def responses(twin: Twin, nodes: Array) -> Array:
    """Change of every track per change of its point's own place in the body, (frames, N, 3, r), r = 3.

    The place is its material coordinates, and for a sheet or a rod its offset from it.
    """
    still, columns = twin.track_nodes(nodes), []
    for axis in range(3):
        columns.append((moved(twin, np.eye(3)[axis] * _SHIFT_M).track_nodes(nodes) - still) / _SHIFT_M)
    return np.stack(columns, axis=-1)


def moved(twin: Twin, shift: Array) -> Twin:
    """The twin with its tracked points at other places in the body: ``shift`` (3,) or (N, 3) [m]."""
    body = twin.body
    shift = np.broadcast_to(shift, (len(body.points), 3))
    if twin.lattice.dim == 3:
        return replace(twin, body=replace(body, points=body.points + shift))
    if twin.lattice.dim == 2:
        body = replace(body, points=body.points + shift[:, :2], offsets=body.offsets + shift[:, 2:])
        return replace(twin, body=body)
    return replace(twin, body=replace(body, offsets=body.offsets + shift))


def turned_starts(scene: Scene, twin: Twin, sigma: float) -> list[Twin]:
    """The twin with its start turned by one standard deviation about every axis that noise leaves uncertain."""
    if twin.lattice.dim == 3 or scene.initial_state == AS_MEASURED or scene.rest_volume_points is not None:
        return []
    start = twin.body.start
    held = np.concatenate([nodes for nodes in twin.held_nodes if len(nodes)] or [np.arange(len(start))])
    centre = start[held].mean(axis=0)
    points = scene.points[0][scene.visible[0]]
    levers = points - points.mean(axis=0)
    axes = np.linalg.svd(start - start.mean(axis=0), full_matrices=False)[2]
    size = float(np.ptp(start, axis=0).max())
    found = []
    for axis in axes:
        arms = np.linalg.norm(np.cross(axis, levers), axis=1)
        lever = float(np.sqrt(np.sum(arms**2)))
        if lever < _LEAST_LEVER * size * np.sqrt(len(points)):
            continue
        turn = Rotation.from_rotvec(axis * sigma / lever)
        turned = replace(twin.body, start=centre + turn.apply(start - centre))
        if twin.lattice.dim == 1:  # the points stay where they were seen
            moved_by = twin.lattice.interpolation(twin.body.points) @ (turned.start - start)
            turned = replace(turned, offsets=twin.body.offsets - moved_by)
        found.append(replace(twin, body=turned))
    return found
