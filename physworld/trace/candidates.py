"""Candidates of a trace: every effect of the registry that makes sense for the twin, in the variants that are tried.

A variant fixes the numbers that only shape an effect (a direction, a place, a time) and leaves its gates free, so that
one simulation per gate shows what it does. Where one shape does not stand for all, an effect has several variants; a
refit then frees the shape of the best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from physworld.effects.base import Strength
from physworld.effects.places import body_size, middle_of_free_end
from physworld.effects.registry import EFFECTS
from physworld.trace.unknowns import Unknown, of_strength, with_strengths
from physworld.twin.twin import Twin

Shape = dict[str, float]
Mirror = Callable[[Shape], Shape]
_SHAPE_STEP = 0.01  # difference step of a shape, of its range
_RELAXATIONS_S = (0.02, 0.1, 0.5)
_DIAGONAL = 0.25 * np.pi
_KNOWN_BEFOREHAND = {"tilt_x_rad": 0.1, "tilt_y_rad": 0.1}
"""Deviations of what is known before any recording: who sets up a camera sees a frame that is far off the vertical.

A strong recording overrules them, and where it says a tilt that nobody believes that stays so. A weak one that hardly
tells a tilt of 3 degrees from one of 13 says the one that is believed.
"""
_SHORTEST = 0.05  # length of a tether on its other side over the one at rest


@dataclass(frozen=True)
class Candidate:
    """A variant of an effect.

    Attributes:
        effect: name in the registry.
        variant: what tells it from others of the same effect.
        gates: strengths that are free from the start.
        fixed: shapes, as the variant has them.
        shapes: which of them a refit frees.
        kind: where the effect enters.
        mirror: from a shape to another one that to first order does the same; None where there is none.
    """

    effect: str
    variant: str
    gates: tuple[Strength, ...]
    fixed: Shape = field(default_factory=dict)
    shapes: tuple[Strength, ...] = ()
    kind: str = "force"
    mirror: Mirror | None = None

    @property
    def label(self) -> str:
        """For reports."""
        return self.effect if not self.variant else f"{self.effect} ({self.variant})"

    def unknowns(self) -> list[Unknown]:
        """The gates, in units of their probes; with what is known of them beforehand."""
        return [
            replace(of_strength(self.effect, gate), prior=(0.0, _KNOWN_BEFOREHAND[gate.name] / gate.probe))
            if gate.name in _KNOWN_BEFOREHAND
            else of_strength(self.effect, gate)
            for gate in self.gates
        ]

    def shape_unknowns(self) -> list[Unknown]:
        """The shapes that a refit frees, from where the variant has them."""
        return [
            of_strength(self.effect, s, _SHAPE_STEP * (s.high - s.low), self.fixed[s.name])
            for s in self.shapes
        ]

    def prepared(self, twin: Twin) -> Twin:
        """The twin with the variant's shapes and closed gates."""
        return with_strengths(twin, self.effect, self.fixed) if self.fixed else twin


def candidates(twin: Twin, names: tuple[str, ...] = ()) -> tuple[list[Candidate], dict[str, str]]:
    """Every variant of the named effects (all by default), and why the other effects were refused."""
    found: list[Candidate] = []
    refused: dict[str, str] = {}
    for name, effect in EFFECTS.items():
        if names and name not in names:
            continue
        reason = effect.why_not(twin)
        if reason is not None:
            refused[name] = reason
            continue
        known = {s.name: s for s in effect.strengths(twin)}
        mirror = _MIRRORS[name](twin) if name in _MIRRORS else None
        for variant in _VARIANTS.get(name, _plain)(twin, known):
            gates = tuple(known[gate] for gate in variant.gates)
            shapes = tuple(known[shape] for shape in variant.shapes)
            found.append(Candidate(name, variant.label, gates, variant.fixed, shapes, effect.kind, mirror))
    return found, refused


@dataclass(frozen=True)
class _Variant:
    gates: tuple[str, ...]
    label: str = ""
    fixed: Shape = field(default_factory=dict)
    shapes: tuple[str, ...] = ()


Known = dict[str, Strength]


def _plain(twin: Twin, known: Known) -> list[_Variant]:
    return [_Variant(tuple(s.name for s in known.values() if s.gate))]


def _one_by_one(*groups: tuple[str, ...]) -> Callable[[Twin, Known], list[_Variant]]:
    """One variant a group of gates; a group's name is its first gate's."""

    def variants(twin: Twin, known: Known) -> list[_Variant]:
        present = [tuple(gate for gate in group if gate in known) for group in groups]
        return [_Variant(group, group[0]) for group in present if group]

    return variants


def _relaxation(twin: Twin, known: Known) -> list[_Variant]:
    gates = tuple(s.name for s in known.values() if s.gate)
    return [
        _Variant(gates, f"{time:g} s", {"relaxation_s": time}, ("relaxation_s",)) for time in _RELAXATIONS_S
    ]


def _fibres(twin: Twin, known: Known) -> list[_Variant]:
    """Directions over the half circle, for a solid over the half sphere: axes and the diagonals between them."""
    if "elevation_rad" not in known:
        angles = [(azimuth, None) for azimuth in (0.0, _DIAGONAL, -_DIAGONAL, 2 * _DIAGONAL)]
    else:
        angles = [(a, 0.0) for a in (0.0, _DIAGONAL, -_DIAGONAL, 2 * _DIAGONAL)]
        angles += [(0.0, 2 * _DIAGONAL), (0.0, _DIAGONAL), (0.0, -_DIAGONAL)]
        angles += [(2 * _DIAGONAL, _DIAGONAL), (2 * _DIAGONAL, -_DIAGONAL)]
    variants = []
    for azimuth, elevation in angles:
        fixed = {"azimuth_rad": azimuth}
        label = f"{np.degrees(azimuth):.0f}°"
        if elevation is not None:
            fixed["elevation_rad"] = elevation
            label += f", {np.degrees(elevation):.0f}°"
        variants.append(_Variant(("ratio",), label, fixed, tuple(fixed)))
    return variants


def _tethers(twin: Twin, known: Known) -> list[_Variant]:
    """Relaxed springs from the middle of the free end in every direction: axes, and the diagonals between them.

    The anchor stands in the room; which material is tied is left to each recording's twin.
    """
    end, reach = middle_of_free_end(twin), body_size(twin)
    axes = np.eye(3)
    ways = [*axes]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        ways += [axes[i] + axes[j], axes[i] - axes[j]]
    variants = []
    for way in ways:
        unit = way / np.linalg.norm(way)
        anchor = end + reach * unit
        fixed = {f"anchor_{a}_m": float(p) for a, p in zip("xyz", anchor, strict=True)}
        fixed["rest_length_m"] = reach
        label = "towards " + " ".join(f"{p:+.0f}" for p in np.sign(np.round(way, 6)))
        shapes = tuple(f"anchor_{a}_m" for a in "xyz")
        variants.append(_Variant(("stiffness_n_m",), label, fixed, shapes))
    return variants


def _other_side(twin: Twin) -> Mirror:
    """To the tether that pushes from the other side with the force of one that pulls, or pulls with one's that pushes.

    What tells the two apart is how a spring's force turns with it, which is of second order.
    """
    end = middle_of_free_end(twin)

    def mirror(shape: Shape) -> Shape:
        way, rest = np.array([shape[f"anchor_{a}_m"] for a in "xyz"]) - end, shape["rest_length_m"]
        length = max(float(np.linalg.norm(way)), 1e-9)
        other = end - way / length * max(2.0 * rest - length, _SHORTEST * rest)
        return shape | {f"anchor_{a}_m": float(p) for a, p in zip("xyz", other, strict=True)}

    return mirror


def _fields(twin: Twin, known: Known) -> list[_Variant]:
    """A slope along the body's axes, and bumps along its longest."""
    axes = "xyz"[: twin.lattice.dim]
    span = np.ptp(twin.lattice.particle_coordinates, axis=0)
    along = axes[int(np.argmax(span))]
    variants = [_Variant(tuple(f"slope_{a}" for a in axes), "slope")]
    for place in (-0.5, 0.0, 0.5):
        fixed = {f"bump_{a}": 0.0 for a in axes} | {f"bump_{along}": place}
        variants.append(_Variant(("bump",), f"bump at {place:+g}", fixed, (f"bump_{along}",)))
    return variants


def _clamps(twin: Twin, known: Known) -> list[_Variant]:
    """Angles; the reach only where grips prescribe nodes: a reach within a cell is what softness is."""
    angles = _Variant(("angle_x_rad", "angle_y_rad", "angle_z_rad"), "angle_x_rad")
    reach = [_Variant(("reach_m",), "reach_m")] if twin.grip_softness == 0 else []
    return [*reach, angles]


_VARIANTS: dict[str, Callable[[Twin, Known], list[_Variant]]] = {
    "rest_shape": _one_by_one(
        ("strain_x", "strain_y", "strain_z"), ("curvature_1_per_m", "curvature_2_per_m")
    ),
    "stiffness_field": _fields,
    "mass_field": _fields,
    "gravity_tilt": _one_by_one(("tilt_x_rad", "tilt_y_rad"), ("magnitude",)),
    "viscoelastic_maxwell": _relaxation,
    "anisotropy": _fibres,
    "tether": _tethers,
    "ground_friction": _one_by_one(("change",), ("height_m",)),
    "clamp_offset": _clamps,
}

_MIRRORS: dict[str, Callable[[Twin], Mirror]] = {"tether": _other_side}
