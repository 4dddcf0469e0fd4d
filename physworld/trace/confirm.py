"""Confirmation: candidates refitted with the full simulator, alone and in pairs, and compared across blocks.

The simplest model first. Singles are refitted in the order of their scores, one variant of an effect at a time. Where
the best single leaves more than it should, what it leaves is scored again with its own sensitivities projected out, and
pairs of it with the best seconds are refitted.

Stiffness and how a body is held trade along a valley of the misfit: a grip may be softer or harder, a clamp may reach
farther or less far, and what fits best on one side of where a lattice has its nodes is another basin than on the other.
Scouts go first, without a Jacobian of their own; the best is refitted from where it ends, if it comes near.

How a sheet bends beside how it stretches, and twists beside how it bends, is calibrated (a mesh of hinges is no plate).
An effect that a sheet lacks is first answered by those numbers, and what they took they keep while the effect is
refitted: fibres of a slab came out a third too weak beside a bending stiffness a quarter too high. So the leading
models are refitted as homogeneous plates too (:func:`as_a_plate`), and of two that predict left-out blocks alike the
simpler one is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO
from physworld.engine.terms.soft_grips import AS_HELD
from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Job, Simulations
from physworld.estimation.unknowns import Unknown, at, bounds_of, starts_of
from physworld.estimation.whitening import Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.comparison import CrossValidation, better_beyond_chance, cross_validated
from physworld.trace.score import Score, orthonormal, project
from physworld.trace.unknowns import REACH, SOFTNESS, already

_STARTS, _GLANCE = 3, 2  # variants of an effect that are tried, and iterations after which the best goes on
_WORSE = 3.0  # a search is left that is this many times as far from the noise as the best so far
_HALF = 0.5  # and has not removed this share of what the model without the effect leaves
_ELSEWHERE = tuple(0.12 * k for k in range(-4, 5))  # logarithms of the stiffness: a scan through the optimum
_FURTHER = (3.0, 9.0)  # times the linear estimate of a strength, which is low where motion is out of phase
_AROUND = (-0.48, -0.24, 0.24, 0.48)  # logarithms of the stiffness where a strength without shapes starts too
_HELD = (-2.0, 2.0)  # places of the clamp's reach, in its steps
_TRIED = 2  # starts elsewhere that are followed
_MULTIPLES = tuple(
    2.0**k for k in range(-5, 3)
)  # of a strength, tried beside another model's calibrated numbers
_WORTH_A_LOOK = 4.0  # times a model's squared residual up to which it is searched from there
_MIRRORED = 2  # times the iterations of a refit: a mirror image is a guess
_NUDGE = 0.1  # of a probe: where a search starts if the linear estimate says none, so that shapes can show
_SOFTNESS_SHARES = (0.15, 0.4, 1.0)  # of ``AS_HELD``
_REACHES = (-1.0, 1.0)  # in steps of the reach, quarters of a cell
_SCOUTED = 2  # times the iterations of a refit: a scout's steps are cheap
_POLISHED = 1  # iterations of the best scout's refit: it has come to the optimum already
_PROMISING = 1.5  # times the squared residual of what there is up to which the best scout is followed
_STIFFNESSES = (-0.3, -0.15, 0.0, 0.15)  # logarithms of the stiffness that may go with them
OWN = (TWIST_RATIO, BENDING_RATIO)
_PLATE = 0.0  # logarithm of both ratios of a homogeneous plate


@dataclass(frozen=True)
class Model:
    """A set of effects with everything refitted.

    Attributes:
        members: the candidates in it, in the order in which they were found; none: the declared physics.
        fitted: the optimum.
        validated: its errors on left-out blocks.
    """

    members: tuple[Candidate, ...]
    fitted: Refit
    validated: CrossValidation

    @property
    def names(self) -> tuple[str, ...]:
        """Effects."""
        return tuple(member.effect for member in self.members)

    @property
    def explained(self) -> float:
        """Excess of the squared misfit over the noise."""
        return max(self.fitted.misfit**2 - 1.0, 0.0)


def beats(better: Model, worse: Model) -> bool:
    """Whether left-out blocks are predicted better by more than chance."""
    return better_beyond_chance(better.validated, worse.validated)


@dataclass
class Confirmation:
    """Refits of one trace; keeps what they share."""

    simulations: Simulations
    whitener: Whitener
    block_of_row: Array
    frames: int
    iterations: int

    def model(
        self, base: Model, variants: list[Score], columns: dict[str, Array], best: Model | None = None
    ) -> Model | None:
        """``base`` with one effect more, everything refitted; None where no run was usable.

        Args:
            variants: scores of the effect's variants against the base's residual, the ones to start from.
            columns: whitened sensitivities at zero of every variant, by label, (M, k).
            best: of the models that were refitted before; what is far worse after a few steps is left.
        """
        alone = len(variants) == 1 and not variants[0].candidate.shapes
        hopeless = np.inf if best is None else _hopeless(base, best)
        starts = [
            self._with_gates(base, score, columns[score.candidate.label], alone, hopeless)
            for score in variants
        ]
        usable = [(s.candidate, f) for s, f in zip(variants, starts, strict=True) if f is not None]
        if not usable:
            return None
        candidate, found = min(usable, key=lambda pair: pair[1].misfit)
        unknowns = [*found.unknowns, *candidate.shape_unknowns()]
        if not alone:
            again = refit(
                self.simulations,
                self.whitener,
                found.twin,
                unknowns,
                self.frames,
                self.iterations,
                None,
                hopeless,
            )
            found = again or found
        return Model((*base.members, candidate), found, cross_validated(found, self.block_of_row))

    def elsewhere(self, model: Model) -> Model:
        """The model refitted from other stiffnesses and clamps, if that is better; else itself.

        What the declared physics made of the recording need not lie in the basin where the effect fits: a stiffness
        may be a period off, and a clamp's reach is not smooth. Other basins show as minima of a scan of the stiffness;
        other reaches are tried with what they ask of the other unknowns.
        """
        fitted = model.fitted
        first = np.eye(len(fitted.theta))[0]
        scan = [fitted.theta + shift * first for shift in _ELSEWHERE]
        reaches = _other_reaches(fitted)
        costs = self._costs(fitted, [*scan, *reaches])
        line = np.array(costs[: len(scan)])
        middle = len(scan) // 2
        line[middle] = float(np.sum(fitted.residual**2))
        padded = np.concatenate([[np.inf], line, [np.inf]])
        basins = (line < padded[:-2]) & (line < padded[2:]) & (np.arange(len(line)) != middle)
        starts = [(line[k], scan[k]) for k in np.flatnonzero(basins)]
        starts += list(zip(costs[len(scan) :], reaches, strict=True))
        best = model
        for _, place in sorted(((c, p) for c, p in starts if np.isfinite(c)), key=lambda pair: pair[0])[
            :_TRIED
        ]:
            unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, place, strict=True)]
            twin = at(fitted.twin, unknowns, starts_of(unknowns))
            hopeless = float(np.sum(best.fitted.residual**2))
            other = refit(
                self.simulations, self.whitener, twin, unknowns, self.frames, self.iterations, None, hopeless
            )
            if other is not None and other.misfit < best.fitted.misfit:
                best = Model(model.members, other, cross_validated(other, self.block_of_row))
        return best

    def mirrored(self, model: Model) -> Model:
        """The model refitted from the mirror image of its last effect's shape, if that is better; else itself.

        The sensitivities of the two are the same, so the one from which the search began is as likely the wrong one.
        """
        member, fitted = model.members[-1], model.fitted
        if member.mirror is None:
            return model
        own = next(known.values for known in fitted.twin.effects if known.name == member.effect)
        image = member.mirror({name: float(own[name] or 0.0) for name in own})
        shapes = {u.name: image[s.name] for u, s in zip(member.shape_unknowns(), member.shapes, strict=True)}
        unknowns = [
            u.starting(shapes[u.name] / u.value(1.0) if u.name in shapes else t)
            for u, t in zip(fitted.unknowns, fitted.theta, strict=True)
        ]
        iterations = _MIRRORED * self.iterations
        other = refit(self.simulations, self.whitener, fitted.twin, unknowns, self.frames, iterations)
        return self._with(model, other)

    def held_otherwise(self, model: Model) -> Model:
        """The model refitted from grips that hold harder and softer, if that is better; else itself.

        Args:
            fitted: the optimum (p unknowns).
            simulations: of the recordings.
            whitener: of their residuals.
            frames: that count.
            iterations: of a refit.
        """
        other = held_otherwise(model.fitted, self.simulations, self.whitener, self.frames, self.iterations)
        return self._with(model, other)

    def further(self, model: Model) -> Model:
        """The model refitted once more from where it is, if that is better; else itself."""
        fitted = model.fitted
        other = refit(
            self.simulations, self.whitener, fitted.twin, fitted.unknowns, self.frames, 2 * self.iterations
        )
        return self._with(model, other)

    def clamped_otherwise(self, model: Model) -> Model:
        """The model refitted from clamps that reach less far and farther, if that is better; else itself.

        Args:
            fitted: the optimum (p unknowns).
            simulations: of the recordings.
            whitener: of their residuals.
            frames: that count.
            iterations: of a refit.
        """
        other = clamped_otherwise(model.fitted, self.simulations, self.whitener, self.frames, self.iterations)
        return self._with(model, other)

    def from_place_of(self, model: Model, other: Model, strength: float) -> Model:
        """The model refitted from another one's calibrated numbers and this strength of its one gate, if better."""
        fitted, member = model.fitted, model.members[-1]
        known = dict(zip([u.name for u in other.fitted.unknowns], other.fitted.theta, strict=True))
        known[member.unknowns()[0].name] = strength
        low, high = _bounds(fitted)
        place = [known.get(u.name, t) for u, t in zip(fitted.unknowns, fitted.theta, strict=True)]
        place = np.clip(place, low, high)
        unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, place, strict=True)]
        again = refit(self.simulations, self.whitener, fitted.twin, unknowns, self.frames, self.iterations)
        return self._with(model, again)

    def together(
        self, base: Model, members: tuple[Candidate, ...], strengths: list[float], other: Model
    ) -> Model | None:
        """``base`` with several effects, from these strengths of their gates and another model's calibrated numbers.

        None where no run was usable.

        Args:
            base: what the effects are added to.
            members: the effects.
            strengths: of all their gates in turn, in their units.
            other: the model whose calibrated numbers the search starts from.
        """
        known = dict(zip([u.name for u in other.fitted.unknowns], other.fitted.theta, strict=True))
        calibrated = [
            u.starting(known.get(u.name, t))
            for u, t in zip(base.fitted.unknowns, base.fitted.theta, strict=True)
        ]
        gates = [gate for member in members for gate in member.unknowns()]
        unknowns = [
            *calibrated,
            *(gate.starting(s / gate.value(1.0)) for gate, s in zip(gates, strengths, strict=True)),
        ]
        found = refit(
            self.simulations, self.whitener, base.fitted.twin, unknowns, self.frames, self.iterations
        )
        return None if found is None else Model(members, found, cross_validated(found, self.block_of_row))

    def beside(self, model: Model, other: Model) -> Model:
        """The model refitted from another one's calibrated numbers and what strength of its one gate does best there.

        A body that rings down may be fitted by a drag at one stiffness and by a viscosity at another; that one search
        has found the better basin is no reason to prefer its effect.
        """
        fitted, gate = model.fitted, model.members[-1].unknowns()[0]
        names = [unknown.name for unknown in fitted.unknowns]
        known = dict(zip([u.name for u in other.fitted.unknowns], other.fitted.theta, strict=True))
        gates = {unknown.name for member in model.members for unknown in member.unknowns()}
        low, high = _bounds(fitted)
        place = [t if n in gates else known.get(n, t) for n, t in zip(names, fitted.theta, strict=True)]
        own = names.index(gate.name)
        places = np.tile(np.clip(place, low, high), (len(_MULTIPLES), 1))
        places[:, own] = np.clip(np.multiply(_MULTIPLES, place[own]), low[own], high[own])
        costs = self._costs(fitted, list(places))
        if min(costs) > _WORTH_A_LOOK * float(np.sum(fitted.residual**2)):
            return model
        unknowns = [
            u.starting(t) for u, t in zip(fitted.unknowns, places[int(np.argmin(costs))], strict=True)
        ]
        again = refit(self.simulations, self.whitener, fitted.twin, unknowns, self.frames, self.iterations)
        return self._with(model, again)

    def _with(self, model: Model, other: Refit | None) -> Model:
        """The model at another optimum, if that is better; else itself."""
        if other is None or other.misfit >= model.fitted.misfit:
            return model
        return Model(model.members, other, cross_validated(other, self.block_of_row))

    def _costs(self, fitted: Refit, places: list[Array]) -> list[float]:
        """Squared residuals at places (p,); infinite where a run cannot be trusted."""
        low, high = _bounds(fitted)
        twins = [at(fitted.twin, fitted.unknowns, np.clip(place, low, high)) for place in places]
        runs = self.simulations.run([Job(twin, self.frames) for twin in twins])
        return [np.inf if t is None else float(np.sum(self.whitener.residual(t) ** 2)) for t in runs]

    def _with_gates(
        self, base: Model, score: Score, columns: Array, alone: bool, hopeless: float
    ) -> Refit | None:
        """The refit of a variant whose shape stays as it is."""
        candidate = score.candidate
        gates = candidate.unknowns()
        freed = {gate.name for gate in gates}
        keep = [k for k, u in enumerate(base.fitted.unknowns) if u.name not in freed]
        known = [base.fitted.unknowns[k] for k in keep]
        strengths = _away_from_zero(score.strengths, gates)
        strengths = strengths + [already(base.fitted.twin, gate) for gate in gates]
        linear = _linear(base.fitted, score.strengths, columns)[keep]
        start = np.concatenate([linear, strengths])
        own = np.concatenate([[u.start for u in known], strengths])
        half = np.concatenate([0.5 * (linear + own[: len(known)]), 0.5 * strengths])
        unknowns = [u.starting(t) for u, t in zip([*known, *gates], start, strict=True)]
        prepared = candidate.prepared(base.fitted.twin)
        if alone:
            first = np.eye(len(start))[0]
            far = start.copy()
            far[len(known) :] *= _FURTHER[0]
            places = [own, half, *(np.r_[linear, factor * strengths] for factor in _FURTHER)]
            places += [far + shift * first for shift in _AROUND]
            if len(gates) > 1:
                places += [np.r_[linear, one] for one in _one_by_one(base.fitted, columns, gates)]
            return refit(
                self.simulations, self.whitener, prepared, unknowns, self.frames, self.iterations, places
            )
        return refit(
            self.simulations, self.whitener, prepared, unknowns, self.frames, _GLANCE, [own, half], hopeless,
            brief=True,
        )  # fmt: skip


def _one_by_one(fitted: Refit, columns: Array, gates: list[Unknown]) -> list[Array]:
    """Linear estimates, (k,), with one gate open at a time: what two gates share may have gone to the wrong one."""
    basis = orthonormal(fitted.free_jacobian)
    free, left = project(basis, columns), project(basis, fitted.residual)
    found = []
    for k, gate in enumerate(gates):
        size = float(free[:, k] @ free[:, k])
        one = np.zeros(len(gates))
        one[k] = np.clip(float(free[:, k] @ left) / size, *gate.bounds) if size > 0 else 0.0
        if one[k] != 0.0:
            found.append(one)
    return found


def _hopeless(base: Model, best: Model) -> float:
    """Squared residual above which a rival of ``best`` is not searched any further."""
    noise = float(len(best.fitted.residual))
    left = max(best.fitted.misfit**2 - 1.0, 0.0) * noise
    before = max(base.fitted.misfit**2 - 1.0, 0.0) * noise
    return noise + max(_WORSE * left, _HALF * before)


def _other_reaches(fitted: Refit) -> list[Array]:
    """Places (p,) with another reach of the clamp, the other unknowns where they then fit best to first order."""
    names = [unknown.name for unknown in fitted.unknowns]
    if REACH not in names:
        return []
    k = names.index(REACH)
    others = np.delete(np.arange(len(names)), k)
    answer = np.linalg.lstsq(fitted.jacobian[:, others], fitted.jacobian[:, k], rcond=1e-6)[0]
    found = []
    for reach in _HELD:
        place, change = fitted.theta.copy(), reach - fitted.theta[k]
        place[k] = reach
        place[others] -= answer * change
        found.append(place)
    return found


def _bounds(fitted: Refit) -> tuple[Array, Array]:
    return bounds_of(fitted.unknowns)


def _linear(fitted: Refit, strengths: Array, columns: Array) -> Array:
    """Where the base's unknowns go, to first order, once the candidate has its strengths; (p,)."""
    left = fitted.residual - columns @ strengths
    change = np.linalg.lstsq(fitted.jacobian, left, rcond=1e-8)[0]
    low, high = bounds_of(fitted.unknowns)
    limit = 0.3 * (high - low)
    place: Array = np.clip(fitted.theta + np.clip(change, -limit, limit), low, high)
    return place


def _away_from_zero(strengths: Array, gates: list[Unknown]) -> Array:
    if np.any(np.abs(strengths) > _NUDGE):
        return strengths
    return np.array([_NUDGE if gate.high > 0 else -_NUDGE for gate in gates])


def best_variants(
    ranked: list[Score], least: float, count: int, besides: tuple[str, ...] = ()
) -> list[list[Score]]:
    """The best variants of every effect whose variants together score at least ``least``, ``count`` effects at most.

    Effects come in turn from two orders, by their best variant alone and by all variants together: many columns explain
    much of anything, and one alone may have the wrong shape. One variant where the effect has no shapes to free, else
    the best three: a linear score does not tell which of them leads to the right shape.

    Args:
        ranked: scores, best first.
        least: share of the residual that a variant must explain.
        count: effects at most.
        besides: effects that are in the model already.
    """
    found: dict[str, list[Score]] = {}
    for score in ranked:
        own = found.setdefault(score.candidate.effect, [])
        most = _STARTS if score.candidate.shapes else 1
        wanted = score.family >= least and score.share > 0.0 and score.candidate.effect not in besides
        if wanted and len(own) < most:
            own.append(score)
    alone = [own for own in found.values() if own]  # in the order of their best variants
    together = sorted(alone, key=lambda own: -own[0].family)
    taken = {own[0].candidate.effect: own for pair in zip(alone, together, strict=True) for own in pair}
    return list(taken.values())[:count]


def explained_direction(model: Model, base: Model, basis: Array) -> Array:
    """What a model explains of the base's residual, (M,), after projection."""
    return project(basis, base.fitted.residual - model.fitted.residual)


def held_otherwise(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The best refit from grips that hold harder and softer; itself where none is better or no softness is free.

    Args:
        fitted: the optimum (p unknowns).
        simulations: of the recordings.
        whitener: of their residuals.
        frames: that count.
        iterations: of a refit.
    """
    values = [float(np.log(share * AS_HELD)) for share in _SOFTNESS_SHARES]
    return _scouted(fitted, SOFTNESS, values, simulations, whitener, frames, iterations)


def clamped_otherwise(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The best refit from clamps that reach less far and farther; itself where none is better or no reach is free.

    Args:
        fitted: the optimum (p unknowns).
        simulations: of the recordings.
        whitener: of their residuals.
        frames: that count.
        iterations: of a refit.
    """
    return _scouted(fitted, REACH, list(_REACHES), simulations, whitener, frames, iterations)


def _scouted(
    fitted: Refit,
    name: str,
    values: list[float],
    simulations: Simulations,
    whitener: Whitener,
    frames: int,
    iterations: int,
) -> Refit:
    """The best refit from these values of the unknown of that name, each with several stiffnesses, if it is better."""
    names = [unknown.name for unknown in fitted.unknowns]
    if name not in names:
        return fitted
    k, scouts = names.index(name), []
    limit = _PROMISING * float(np.sum(fitted.residual**2))
    for value in values:
        places = [fitted.theta + shift * np.eye(len(names))[0] for shift in _STIFFNESSES]
        for place in places:
            place[k] = value
        unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, places[0], strict=True)]
        scout = refit(
            simulations, whitener, fitted.twin, unknowns, frames, _SCOUTED * iterations, places[1:],
            hopeless=limit, jacobian=fitted.jacobian,
        )  # fmt: skip
        scouts += [] if scout is None else [scout]
    scout = min(scouts, key=lambda s: s.misfit, default=None)
    if scout is None or float(np.sum(scout.residual**2)) > limit:
        return fitted
    other = refit(simulations, whitener, fitted.twin, scout.unknowns, frames, _POLISHED)
    return fitted if other is None or other.misfit >= fitted.misfit else other


def as_a_plate(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit | None:
    """The refit with both ratios of bending at a homogeneous plate's; None where none is free, or none could be run.

    It is searched from the same stiffness of the membrane, from the same stiffness of bending, and from between.

    Args:
        fitted: the optimum (p unknowns).
        simulations: of the recordings.
        whitener: of their residuals.
        frames: that count.
        iterations: of a refit.
    """
    names = [unknown.name for unknown in fitted.unknowns]
    own = [k for k, name in enumerate(names) if name in OWN]
    if not own:
        return None
    theta = fitted.theta.copy()
    theta[own] = _PLATE
    twin = at(fitted.twin, fitted.unknowns, theta)
    kept = np.delete(np.arange(len(names)), own)
    bends = float(fitted.theta[names.index(BENDING_RATIO)]) if BENDING_RATIO in names else 0.0
    starts = [theta[kept] + share * bends * np.eye(len(kept))[0] for share in (0.0, 0.5, 1.0)]
    unknowns = [fitted.unknowns[k].starting(t) for k, t in zip(kept, starts[0], strict=True)]
    return refit(simulations, whitener, twin, unknowns, frames, iterations, starts[1:])
