"""Tethers between the directions that are tried, and such as pull or push from the start: found without a simulation.

What a spring does to a point that moves by u is, to first order, F + K u with

    F = k (d - l) n        K = k ((1 - l / d) I + (l / d) n n^T)

where k is its stiffness, l its rest length, n the direction of its anchor and d the distance to it at the start. That
is linear in three components of F and six of K. A force on the free end has a sensitivity for every component of F, and
the relaxed springs along axes and diagonals (d = l, K = k n n^T) span those of K. So the sensitivity of every other
tether is a combination of theirs, and directions and distances are searched over the sphere at no cost. Where the best
explains more than anything that was tried, a tether is refitted from there; and where no anchor does, its rest length
is freed as well: how far the force turns with the body is its own (ADR 26).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.effects.places import middle_of_free_end
from physworld.effects.region_force import RegionForce
from physworld.effects.tether import Tether
from physworld.estimation.refit import Refit, refit
from physworld.trace.candidates import Candidate
from physworld.trace.comparison import cross_validated
from physworld.trace.confirm import Confirmation, Model, beats
from physworld.trace.score import Score, Scores, orthonormal, project
from physworld.trace.sensitivity import Response
from physworld.trace.unknowns import of_strength

TETHER, FORCE = Tether.name, RegionForce.name
_DIRECTIONS = 600
_DISTANCES = (
    0.3,
    0.5,
    0.7,
    0.85,
    1.0,
    1.2,
    1.5,
    2.0,
    3.0,
)  # of the anchor at the start, over the rest length
_FOLLOWED = 2  # distances from which a tether is refitted
_MULTIPLES = (1.0, 9.0)  # of the linear strength, which is low where the motion is out of phase
_NEAR = 3.0  # times what the best model leaves above the noise
_REST, _REST_STEP = "rest_length_m", 0.01  # difference step, of its range


@dataclass(frozen=True)
class Start:
    """A tether to begin a refit with: its linear score, and its whitened sensitivity, (M, 1)."""

    score: Score
    columns: Array


def with_tethers(
    confirmation: Confirmation,
    base: Model,
    ranked: Scores,
    columns: dict[str, Array],
    usable: list[Response],
    tried: list[Model],
    complete: float,
) -> list[Model]:
    """The models that were refitted; a tether from between the directions in the place of the other where it is better.

    Args:
        base: what the models add an effect to.
        ranked: all scores against it.
        columns: whitened sensitivities of every variant, by label, (M, k); those of the tethers from here join them.
        usable: what every candidate does to its prediction.
        tried: models with one effect more.
        complete: misfit over the noise up to which nothing is left to explain.
    """
    if TETHER in base.names or any(model.fitted.misfit <= complete for model in (base, *tried)):
        return tried
    others = [model for model in tried if model.names[-1] != TETHER]
    known = [model for model in tried if model.names[-1] == TETHER]
    starts = tethers_between(base.fitted, usable)
    if starts and starts[0].score.share > ranked.ranked[0].share:
        for start in starts[:_FOLLOWED]:
            columns[start.score.candidate.label] = start.columns
            for multiple in _MULTIPLES:
                score = replace(start.score, strengths=multiple * start.score.strengths)
                found = confirmation.model(base, [score], columns)
                known += [found] if found is not None else []
    if not known:
        return tried
    best = min(known, key=lambda model: model.fitted.misfit)
    least = min(model.explained for model in [best, *others])
    if best.fitted.misfit > complete and best.explained <= _NEAR * least:
        best = _any_length(confirmation, best)
    return [*others, best]


def tethers_between(fitted: Refit, responses: list[Response]) -> list[Start]:
    """The best tether at every distance, best first, for what a model leaves; none without the relaxed springs.

    Args:
        fitted: the model.
        responses: what candidates do to its prediction, relaxed springs and a force on the free end among them.
    """
    springs = [r for r in responses if r.candidate.effect == TETHER]
    if not springs:
        return []
    first = springs[0].candidate
    end, rest, gate = middle_of_free_end(fitted.twin), first.fixed[_REST], first.unknowns()[0]
    ways = np.array([[r.candidate.fixed[f"anchor_{a}_m"] for a in "xyz"] for r in springs]) - end
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    if np.linalg.matrix_rank(_squares(ways)) < 6:
        return []
    columns = np.concatenate([r.columns for r in springs], axis=1) / gate.value(1.0)
    columns = columns @ np.linalg.pinv(_squares(ways)).T  # of the six components of K [m/N]
    forces = [r for r in responses if r.candidate.effect == FORCE]
    if forces:
        scale = np.array([unknown.value(1.0) for unknown in forces[0].candidate.unknowns()])
        columns = np.concatenate([columns, forces[0].columns / scale], axis=1)
    basis = orthonormal(fitted.free_jacobian)
    free, left = project(basis, columns), project(basis, fitted.residual)
    normal, product, total = free.T @ free, free.T @ left, float(left @ left)
    if total <= 0.0:
        return []
    every, found = _sphere(_DIRECTIONS), []
    for distance in _DISTANCES if forces else (1.0,):
        isotropic = (1.0 - 1.0 / distance) * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        parts = isotropic + _squares(every) / distance
        if forces:
            parts = np.concatenate([parts, (distance - 1.0) * rest * every], axis=1)
        size = np.einsum("ik,kl,il->i", parts, normal, parts)
        along = parts @ product
        stiffness = np.clip(along / np.maximum(size, 1e-300), 0.0, gate.value(gate.bounds[1]))
        shares = (2.0 * stiffness * along - stiffness**2 * size) / total
        k = int(np.argmax(shares))
        candidate = _anchored(first, end + distance * rest * every[k], every[k])
        strengths = np.array([stiffness[k] / gate.value(1.0)])
        own = (columns @ parts[k] * gate.value(1.0))[:, None]
        direction = project(basis, own) @ strengths
        share = float(shares[k])
        found.append(Start(Score(candidate, share, strengths, direction, 1.0, share), own))
    return sorted(found, key=lambda start: -start.score.share)


def _anchored(candidate: Candidate, anchor: Array, way: Array) -> Candidate:
    fixed = candidate.fixed | {f"anchor_{a}_m": float(c) for a, c in zip("xyz", anchor, strict=True)}
    return replace(candidate, fixed=fixed, variant="towards " + " ".join(f"{c:+.2f}" for c in way))


def _any_length(confirmation: Confirmation, model: Model) -> Model:
    """The tether with its rest length freed, where that predicts left-out blocks better beyond chance; else itself."""
    fitted = model.fitted
    values = next(known.values for known in fitted.twin.effects if known.name == TETHER)
    rest = next(s for s in Tether.strengths(fitted.twin) if s.name == _REST)
    free = of_strength(TETHER, rest, _REST_STEP * (rest.high - rest.low), float(values[_REST] or 0.0))
    other = refit(
        confirmation.simulations, confirmation.whitener, fitted.twin, [*fitted.unknowns, free], confirmation.frames,
        2 * confirmation.iterations,
    )  # fmt: skip
    if other is None:
        return model
    longer = Model(model.members, other, cross_validated(other, confirmation.block_of_row))
    return longer if beats(longer, model) else model


def _squares(ways: Array) -> Array:
    """Components xx, yy, zz, xy, xz, yz of n n^T of unit vectors (D, 3), (D, 6); those off the diagonal twice."""
    x, y, z = ways.T
    return np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)


def _sphere(count: int) -> Array:
    """Directions, evenly over the sphere (a Fibonacci lattice), (count, 3)."""
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
