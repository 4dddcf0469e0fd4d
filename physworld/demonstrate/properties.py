"""What the twin of one episode is made of: fields of stiffness, density and friction, and strengths of effects.

The kernel of the fields is over part features: those that the scene brings (PartField's), carried to the particles,
or a spectral embedding of the rest shape (:mod:`physworld.geometry.features`). A strength of an effect is drawn from
the normal distribution that its estimate and its 95 % interval stand for, cut off at the interval's ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from physworld.arrays import Array
from physworld.demonstrate.config import DemonstrationConfig, StrengthRange
from physworld.demonstrate.perturbation import PropertyField, check_field, perturb, with_space
from physworld.effects.registry import effect
from physworld.errors import SceneUnsupported
from physworld.geometry.features import carry_features, part_features
from physworld.scene import Scene

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

NEIGHBOURS = 4
Z95 = 1.959964  # half-width of a 95 % interval in standard deviations


@dataclass(frozen=True, eq=False)
class Drawn:
    """What an episode's twin differs in from the fitted one; P particles.

    Attributes:
        fields: log(E/E_fit) and log(ρ/ρ_fit), (P, 2) float64; (P, 3) with log(μ/μ_fit) of the ground under each
            particle where the friction is perturbed as a field.
        parameters: changed scalars of the twin, by name.
        strengths: drawn strengths of effects, ``effect.strength`` to value.
        roughness: RMS step of a field between neighbouring particles, in its σ; 0 where it is not perturbed.
        unresolved: share of variance that the Nyström approximation misses at worst.
    """

    fields: Array
    parameters: dict[str, float] = field(default_factory=dict)
    strengths: dict[str, float] = field(default_factory=dict)
    roughness: tuple[float, ...] = (0.0, 0.0)
    unresolved: float = 0.0

    def twin(self, fitted: Twin) -> Twin:
        """The episode's own twin, the fields aside."""
        changed = fitted.with_parameters(**self.parameters) if self.parameters else fitted
        for known in fitted.effects:
            own = {
                name: v
                for name in known.values
                if (v := self.strengths.get(f"{known.name}.{name}")) is not None
            }
            if own:
                changed = changed.with_effect(effect(known.name, **{**known.values, **own}))
        return changed

    def attributes(self) -> dict[str, Any]:
        """What is recorded of it; JSON types only."""
        names = ("log_modulus", "log_density", "log_friction")[: self.fields.shape[1]]
        figures = {
            name: {
                "mean": float(values.mean()),
                "std": float(values.std()),
                "range": [float(values.min()), float(values.max())],
            }
            for name, values in zip(names, self.fields.T, strict=True)
        }
        return {
            **{f"{name}_{kind}": value for name, own in figures.items() for kind, value in own.items()},
            "property_roughness": [round(value, 6) for value in self.roughness],
            "parameters": dict(self.parameters),
            "effect_strengths": dict(self.strengths),
        }


def draw_properties(
    scene: Scene, twin: Twin, config: DemonstrationConfig, generator: np.random.Generator
) -> Drawn:
    """Everything that ``generator`` decides of an episode's twin.

    Args:
        scene: the recording; its part features are used where they are asked for.
        twin: calibrated.
        config: of the demonstrations.
        generator: of every draw.

    Raises:
        SceneUnsupported: supplied features are asked for and the scene has none.
        UnstableSimulation: a field passes its bounds or jumps.
    """
    law = None
    rubs = config.sigma_of("friction") > 0.0 and twin.ground_height_m is not None
    as_field = rubs and twin.form.supports("friction_field")
    named = ("stiffness", "density", "friction") if as_field else ("stiffness", "density")
    if config.perturbation == "p3" and any(config.sigma_of(name) for name in named):
        law = property_field(scene, twin, config)
    count = len(twin.particles_rest)
    columns, roughness = [], []
    pairs = _pairs(_key(twin))
    for name in named:
        sigma = config.sigma_of(name)
        values = perturb(config.perturbation, sigma, count, law, generator, config.largest_factor)
        roughness.append(check_field(values, sigma, pairs, law, config.largest_factor))
        columns.append(values)
    parameters: dict[str, float] = {}
    if rubs and not as_field:  # its contact knows one coefficient
        sigma = config.sigma_of("friction")
        log_factor = perturb("uniform", sigma, 1, None, generator, config.largest_factor)[0]
        parameters["ground_friction"] = float(twin.ground_friction * np.exp(log_factor))
    strengths = {
        f"{r.effect}.{r.name}": draw_strength(r, generator) for r in ranges_of(twin, config.strengths)
    }
    return Drawn(
        fields=np.stack(columns, axis=1),
        parameters=parameters,
        strengths=strengths,
        roughness=tuple(roughness),
        unresolved=0.0 if law is None else law.unresolved,
    )


def ranges_of(twin: Twin, ranges: Sequence[StrengthRange]) -> list[StrengthRange]:
    """Those ranges whose effect and strength the twin has, cut at the bounds that the effect states for this twin.

    An estimate on its bound keeps its value.
    """
    found = []
    for known in twin.effects:
        bounds = {s.name: (s.low, s.high) for s in type(known).strengths(twin)}
        for one in ranges:
            if one.effect != known.name or one.name not in known.values:
                continue
            low, high = bounds.get(one.name, (-np.inf, np.inf))
            low, high = min(max(one.low, low), one.value), max(min(one.high, high), one.value)
            found.append(StrengthRange(one.effect, one.name, one.value, low, high))
    return found


def draw_strength(known: StrengthRange, generator: np.random.Generator) -> float:
    """A strength within its interval: normal about the estimate, the interval's half as Z95 σ, cut at its ends."""
    sigma = (known.high - known.low) / (2.0 * Z95)
    if sigma == 0.0:
        return known.value
    low, high = ndtr((known.low - known.value) / sigma), ndtr((known.high - known.value) / sigma)
    drawn = known.value + sigma * ndtri(generator.uniform(low, high))
    return float(np.clip(drawn, known.low, known.high))


def property_field(scene: Scene, twin: Twin, config: DemonstrationConfig) -> PropertyField:
    """The field's law for a twin of ``scene``; the same object for every episode."""
    supplied = scene.part_features if config.features != "geometric" else None
    if supplied is None and config.features == "supplied":
        raise SceneUnsupported(f"scene {scene.name!r} has no part_features; features 'supplied' needs them")
    space = 0.0 if config.space_scale is None else config.space_scale
    settings = (config.length_scale, space, config.landmarks, config.unresolved)
    if supplied is None:
        return _geometric_field(_key(twin), config.feature_count, *settings)
    sources, features = _supplied(scene, supplied)
    shapes = (sources.tobytes(), features.tobytes(), features.shape[1], twin.particles_start.tobytes())
    return _supplied_field(_key(twin), *shapes, *settings)


def _supplied(scene: Scene, features: Array) -> tuple[Array, Array]:
    """Places [m] and features of what the scene brings: of its volume points, else of its visible tracked points."""
    features = np.ascontiguousarray(features, dtype=np.float64)
    if scene.rest_volume_points is not None and len(features) == len(scene.rest_volume_points):
        return np.ascontiguousarray(scene.rest_volume_points, dtype=np.float64), features
    seen = scene.visible[0]
    return np.ascontiguousarray(scene.points[0][seen], dtype=np.float64), features[seen]


def _key(twin: Twin) -> bytes:
    """The particles of the rest shape as a key of the caches."""
    return np.ascontiguousarray(twin.particles_rest, dtype=np.float64).tobytes()


@lru_cache(maxsize=4)
def _geometric_field(
    points: bytes, count: int, length: float, space: float, landmarks: int, unresolved: float
) -> PropertyField:
    """The law over the spectral embedding of float64 points."""
    rest = np.frombuffer(points).reshape(-1, 3)
    return _field(part_features(rest, count), rest, length, space, landmarks, unresolved)


@lru_cache(maxsize=4)
def _supplied_field(
    points: bytes,
    sources: bytes,
    features: bytes,
    width: int,
    targets: bytes,
    length: float,
    space: float,
    landmarks: int,
    unresolved: float,
) -> PropertyField:
    """The law over features (S, ``width``) of sources (S, 3), carried to the particles at their start."""
    places = np.frombuffer(sources).reshape(-1, 3)
    given = np.frombuffer(features).reshape(-1, width)
    carried = carry_features(places, given, np.frombuffer(targets).reshape(-1, 3))
    return _field(carried, np.frombuffer(points).reshape(-1, 3), length, space, landmarks, unresolved)


def _field(
    features: Array, rest: Array, length: float, space: float, landmarks: int, unresolved: float
) -> PropertyField:
    if space > 0.0:
        size = float(np.ptp(rest, axis=0).max())
        features = with_space(features, rest, length, space * size)
    return PropertyField(features, length, landmarks, unresolved)


@lru_cache(maxsize=4)
def _pairs(points: bytes) -> Array:
    """Pairs (M, 2) of particles side by side: each with its nearest."""
    places = np.frombuffer(points).reshape(-1, 3)
    near = min(NEIGHBOURS, len(places) - 1)
    if near < 1:
        return np.empty((0, 2), dtype=np.int64)
    _, indices = cKDTree(places).query(places, k=near + 1)
    pairs = np.stack([np.repeat(np.arange(len(places)), near), indices[:, 1:].ravel()], axis=1)
    return np.unique(np.sort(pairs, axis=1), axis=0)
