"""What ``benchmarks.trace.power`` injects: a direction in every effect's strengths, scaled to a wanted displacement.

A *level* says how far an effect moves the tracked points from where they would have been, root mean square per axis
over the training frames, in units of the tracking noise. The strength that does it is found by simulation; bounds of
the registry clip it, and what the effect's own file does not believe. Shapes (fibre directions, places, relaxation
times) lie between the variants that a trace tries, and where an effect has a group of components all of them act. A
camera whose scale is off scales every frame, frame 0 too, which is where a trace learns the points' places from;
displacement counts from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.trace.power_objects import SIGMA_M, Object, observed
from physworld.effects.places import body_size, middle_of_free_end
from physworld.effects.registry import EFFECTS, effect
from physworld.errors import EffectRefused, SimulationError
from physworld.twin.twin import Twin

LEVELS = (1.0, 3.0, 10.0)  # displacement over noise
_CLOSE = 0.15  # relative difference to the wanted displacement that ends the search
_TRIALS = 8
_FACTOR = 30.0  # of one step of the search
_FAILED = 0.3  # factor after a run that cannot be trusted
_SCALE = "measurement_scale"

_DIRECTIONS: dict[str, dict[str, float]] = {
    "rest_shape": {"curvature_1_per_m": 1.0},
    "stiffness_field": {"bump": 1.0},
    "mass_field": {"bump": 1.0},
    "gravity_tilt": {"tilt_x_rad": 0.8, "tilt_y_rad": -0.6},
    "buoyancy": {"density_ratio": 1.0, "added_mass_ratio": 0.5},
    "wind": {"push_x_m_s2": 0.3, "push_y_m_s2": 0.4, "rate_per_s": 1.0},  # 0.5 m/s, whatever the scale
    "viscoelastic_maxwell": {"shear_modulus_pa": 1.0, "share": 1.0},
    "clamp_offset": {"angle_x_rad": 0.5, "angle_y_rad": 0.7, "angle_z_rad": 0.5},
    "region_force": {"force_x_n": 0.3, "force_y_n": 0.8, "force_z_n": 0.5},
    "ground_friction": {"change": 1.0},
    "measurement_drift": {"x_m_s": 0.6, "y_m_s": -0.5, "z_m_s": 0.4},
}
"""Of effects with several gates; of others the only one that fits the body."""


@dataclass(frozen=True)
class Injection:
    """An effect at a strength.

    Attributes:
        tracks: what the camera reports without noise, (T, N, 3) [m].
        strengths: gates that are open.
        size: the amount of all gates together: root of the sum of squares, for the table.
        unit: its unit.
        displacement: root mean square over the noise.
        clipped: whether a bound of the registry kept it from the wanted displacement.
    """

    tracks: np.ndarray
    strengths: dict[str, float]
    size: float
    unit: str
    displacement: float
    clipped: bool


def refusal(name: str, known: Object) -> str | None:
    """Why an effect makes no sense for the object; None where it does."""
    return EFFECTS[name].refuses(known.truth)


def inject(name: str, known: Object, without: np.ndarray, level: float) -> Injection | None:
    """The effect at the strength that displaces by ``level``; None where no strength can be simulated.

    Args:
        without: tracks without the effect, (T, N, 3) [m].
    """
    twin = known.truth
    direction, shapes, most, scale = _direction(name, twin)
    window = slice(1, known.scene.train[1])
    best: Injection | None = None
    for _ in range(_TRIALS):
        strengths = {gate: scale * part for gate, part in direction.items()}
        try:
            changed = twin.with_effect(effect(name, **shapes, **strengths))
            tracks = observed(changed, known.scene) if name != _SCALE else _scaled(twin, without, strengths)
        except (SimulationError, EffectRefused):
            scale *= _FAILED
            continue
        shift = (tracks - tracks[0]) - (without - without[0])
        moved = float(np.sqrt(np.mean(shift[window] ** 2))) / SIGMA_M
        size = float(np.linalg.norm(list(strengths.values())[: _alike(name)]))
        at_bound = scale >= most * (1 - 1e-9)
        found = Injection(
            tracks, strengths, size, _unit(name, twin, direction), moved, at_bound and moved < level
        )
        if best is None or _off(found, level) < _off(best, level):
            best = found
        if abs(moved / level - 1) < _CLOSE or (at_bound and moved < level):
            break
        scale = min(scale * float(np.clip(level / max(moved, 1e-12), 1 / _FACTOR, _FACTOR)), most)
    return best


def _scaled(twin: Twin, without: np.ndarray, strengths: dict[str, float]) -> np.ndarray:
    """What a camera shows of true tracks whose scale is off, about the grip."""
    centre = twin.controllers_start.mean(axis=0)
    return centre + (1.0 + strengths["scale"]) * (without - centre)


def _off(found: Injection, level: float) -> float:
    return abs(float(np.log(max(found.displacement, 1e-12) / level)))


def _alike(name: str) -> int | None:
    """Leading gates with one unit, of which the size is stated."""
    return {"wind": 2, "buoyancy": 1}.get(name)


def _unit(name: str, twin: Twin, direction: dict[str, float]) -> str:
    units = {s.name: s.unit for s in EFFECTS[name].strengths(twin)}
    return units[next(iter(direction))]


def _direction(name: str, twin: Twin) -> tuple[dict[str, float], dict[str, float], float, float]:
    """Gates per unit of scale, shapes, the largest scale within the bounds, and a scale to start from."""
    known = {s.name: s for s in EFFECTS[name].strengths(twin)}
    gates = {g: p for g, p in _DIRECTIONS.get(name, {}).items() if g in known}
    if not gates:
        gates = {next(s.name for s in known.values() if s.gate): 1.0}
    bounds = [(known[g].high if p > 0 else known[g].low) / p for g, p in gates.items()]
    start = max(known[g].probe / abs(p) for g, p in gates.items())
    shapes = _shapes(name, twin, known)
    most = _believed(name, gates, shapes, min(bounds))
    return gates, shapes, most, min(start, most)


def _believed(name: str, gates: dict[str, float], shapes: dict[str, float], most: float) -> float:
    """The largest scale up to ``most`` that is believed of the effect, within a percent of that."""

    def doubted(scale: float) -> bool:
        strengths = {gate: scale * part for gate, part in gates.items()}
        return effect(name, **shapes, **strengths).implausible() is not None

    if not doubted(most):
        return most
    low, high = 0.0, most
    while high - low > 0.01 * low:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if doubted(middle) else (middle, high)
    return low


def _shapes(name: str, twin: Twin, known: dict) -> dict[str, float]:
    """Numbers that only shape the effect, away from those of the variants that a trace tries."""
    if name == "tether":
        end, reach = middle_of_free_end(twin), body_size(twin)
        way = np.array([0.3, 0.9, 0.32])
        anchor = end + 0.7 * reach * way / np.linalg.norm(way)
        return {
            **{f"anchor_{a}_m": float(c) for a, c in zip("xyz", anchor, strict=True)},
            "rest_length_m": 0.7 * reach,
        }
    wanted = {
        "stiffness_field": {"bump_x": 0.25},
        "mass_field": {"bump_x": 0.6},
        "viscoelastic_maxwell": {"relaxation_s": 0.05},
        "anisotropy": {"azimuth_rad": 0.4, "elevation_rad": 0.3},
        "adhesion": {"reach_m": 0.004},
    }
    return {shape: value for shape, value in wanted.get(name, {}).items() if shape in known}
