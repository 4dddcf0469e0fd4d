"""The verdict: from refitted models to one honest answer.

========================  ============================================================================================
``nothing_to_explain``    the declared physics is near the noise, and no effect explains a share that matters
``named``                 one model of effects reaches the noise, or removes most of what is above it, and no other does
``equivalent_set``        other effects do as well: these data cannot tell them apart
``data_issue``            the best are faults of the measurement only
``numerical_issue``       the strength moves, or goes, with the resolution
``unexplained``           something is there and no effect of the library accounts for it
========================  ============================================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from physworld.arrays import Array
from physworld.trace.comparison import alikeness, better_beyond_chance, difference, seen_through
from physworld.trace.compound import count_of_effects, other_names, whole_of
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model, beats, explained_direction

NAMED, EQUIVALENT, DATA, NUMERICAL = "named", "equivalent_set", "data_issue", "numerical_issue"
UNEXPLAINED, NOTHING = "unexplained", "nothing_to_explain"
_DISCREPANCY = 0.05
_BELOW_NOISE = 0.9
_NOISE_KNOWN = 0.05  # share to which the variance of the noise is known


@dataclass(frozen=True)
class Verdict:
    """An answer.

    Attributes:
        name: of the verdict.
        model: what is added; the declared physics where nothing is.
        equivalent: models that do as well.
        reason: one sentence for people.
    """

    name: str
    model: Model
    equivalent: tuple[Model, ...] = ()
    reason: str = ""

    @property
    def added(self) -> Model | None:
        """What a twin is given to predict with: what is named, or the best of an equivalent set.

        The models of a set predict the same as far as the data tell, so the best one is better than none. A fault of
        the measurement is nothing that a body carries.
        """
        physical = any(member.kind != "measurement" for member in self.model.members)
        return self.model if self.name in (NAMED, EQUIVALENT) and physical else None


def decide(
    declared: Model,
    models: list[Model],
    basis: Array,
    agreement: dict[tuple[str, ...], bool],
    resolved: float,
    config: TraceConfig,
    tried: int,
    solver: Array,
    block_of_row: Array,
    chance: Callable[[Model], bool] = lambda model: False,
) -> Verdict:
    """The verdict.

    Args:
        declared: the declared physics alone, refitted.
        models: refitted models with effects.
        basis: orthonormal sensitivities of what is calibrated anyway, (M, p).
        agreement: for models that were refitted at a second resolution (by their names), whether it agreed.
        resolved: misfit of the declared physics once what other cells and time steps change is taken out.
        tried: number of candidate effects.
        solver: orthonormal directions of what other cells and time steps change, (M, k).
        block_of_row: block of every row, (M,).
        chance: whether the best score under random signs reaches a model's.
    """
    before = declared.fitted.misfit
    real = claimable(declared, models, config, solver, block_of_row, chance)
    if not real:
        if before <= config.near_floor:
            reason = f"misfit {before:.2f} of the noise, and none of {tried} effects explains more"
            return Verdict(NOTHING, declared, (), reason)
        if resolved <= config.near_floor:
            reason = f"misfit {before:.2f} of the noise, {resolved:.2f} without what other cells and time steps change"
            return Verdict(NUMERICAL, declared, (), reason)
        reason = f"misfit {before:.2f} of the noise; none of {tried} effects accounts for it"
        return Verdict(UNEXPLAINED, declared, (), reason)
    ordered = simplest_first(real, declared)
    best = next((m for m in ordered if agreement.get(m.names)), ordered[0])
    after = best.fitted.misfit
    what = " and ".join(best.names)
    figures = f"misfit {before:.2f} to {after:.2f} of the noise"
    if not accounts(best, declared, config):
        reason = f"{what} fits best among {tried} effects but leaves too much to be named: {figures}"
        return Verdict(UNEXPLAINED, declared, (), reason)
    unbelieved = _better_unbelieved(best, models, declared)
    if unbelieved is not None:
        left = f"misfit {unbelieved.fitted.misfit:.2f} of the noise for {after:.2f}"
        reason = f"{implausible(unbelieved)}, but explains more than {what}: {left}"
        return Verdict(UNEXPLAINED, declared, (), reason)
    if agreement.get(best.names) is False and before <= config.near_floor:
        reason = (
            f"misfit {before:.2f} of the noise, and what {what} seems to explain moves with the resolution"
        )
        return Verdict(NOTHING, declared, (), reason)
    if agreement.get(best.names) is False:
        reason = f"the strength of {what} moves with the resolution: {figures}"
        return Verdict(NUMERICAL, declared, (), reason)
    same = tuple(
        m
        for m in real
        if m is not best
        and agreement.get(m.names) is not False
        and (
            indistinguishable(m, best, basis, declared, config.alike)
            or (m in ordered and richer_and_better(m, best, basis, declared, config.alike))
        )
    )
    family = (best, *same)
    measured = [all(member.kind == "measurement" for member in model.members) for model in family]
    if all(measured):
        return Verdict(
            DATA, best, same, f"best supported among {tried}: {what}, a fault of the data; {figures}"
        )
    if same:
        others = ", ".join(" and ".join(model.names) for model in same)
        return Verdict(EQUIVALENT, best, same, f"{what} or {others}: these data cannot tell; {figures}")
    return Verdict(NAMED, best, (), f"best supported among {tried} candidates: {what}; {figures}")


def helps(model: Model, declared: Model, config: TraceConfig) -> bool:
    """Left-out blocks are predicted better than by the declared physics, by more than chance and by a share that
    matters, and its numbers can be believed.
    """
    if implausible(model) is not None:
        return False
    share = 1.0 - model.validated.mean / declared.validated.mean
    return beats(model, declared) and share >= config.material_share


def claimable(
    declared: Model,
    models: list[Model],
    config: TraceConfig,
    solver: Array,
    block_of_row: Array,
    chance: Callable[[Model], bool],
) -> list[Model]:
    """Models that help, also where the solver's own directions are taken out of what they explain.

    Where the declared physics is near the noise already, little says that there is anything to explain but the score:
    there it has to be beyond chance.

    Args:
        declared: the declared physics.
        models: what was refitted.
        config: settings.
        solver: orthonormal directions of the solver's own error, (M, k).
        block_of_row: block of frames of every residual, (M,).
        chance: whether chance reaches a model's score.
    """
    quiet = declared.fitted.misfit <= config.acceptable
    return [
        model
        for model in models
        if helps(model, declared, config)
        and survives(model, declared, solver, block_of_row, config)
        and not (quiet and chance(model))
    ]


def survives(model: Model, declared: Model, solver: Array, block_of_row: Array, config: TraceConfig) -> bool:
    """Whether what a model explains is more than what other cells and time steps would change.

    Args:
        model: with an effect.
        declared: without.
        solver: orthonormal directions of the solver's own error, (M, k).
        block_of_row: block of frames of every residual, (M,).
        config: settings.
    """
    before, after = (seen_through(m.fitted.residual, solver, block_of_row) for m in (declared, model))
    share = 1.0 - after.mean / before.mean
    return better_beyond_chance(after, before) and share >= config.material_share


def implausible(model: Model) -> str | None:
    """Why nobody would believe a model's strengths; None where one may."""
    own = (known.implausible() for known in model.fitted.twin.effects if known.name in model.names)
    return next((reason for reason in own if reason is not None), None)


def _better_unbelieved(best: Model, models: list[Model], declared: Model) -> Model | None:
    """The model that nobody would believe and that predicts clearly better than the best of the others, if one does.

    Then something is there that looks like it, and the next best name would be a wrong one.
    """
    found = [
        m
        for m in models
        if len(m.members) == 1 and implausible(m) is not None and not as_good(best, m, declared)
    ]
    better = [m for m in found if m.validated.mean < best.validated.mean]
    return min(better, key=lambda m: m.validated.mean, default=None)


def accounts(model: Model, declared: Model, config: TraceConfig) -> bool:
    """The model is complete, or one effect alone is nearly so and has removed most of what was above the noise.

    Two effects have so much freedom that a nearly complete pair is no evidence for either.
    """
    after, before = model.fitted.misfit, declared.fitted.misfit
    if after <= config.near_floor or len(model.members) > 1:
        return after <= config.near_floor
    removed = (before**2 - after**2) / max(before**2 - 1.0, 1e-12)
    return after <= config.acceptable and removed >= config.most_of_it


def simplest(models: list[Model], declared: Model) -> Model:
    """The model with fewest effects, then fewest unknowns, among those that are as good as the best."""
    best = min(models, key=lambda m: m.validated.mean)
    near = [m for m in models if as_good(m, best, declared)]
    return min(near, key=lambda m: (count_of_effects(m), len(m.fitted.unknowns), m.validated.mean))


def simplest_first(models: list[Model], declared: Model) -> list[Model]:
    """The simplest of those that are as good as the best, then the others of them, the next simplest first."""
    if not models:
        return []
    best = min(models, key=lambda m: m.validated.mean)
    left, found = [m for m in models if as_good(m, best, declared)], []
    while left:
        found.append(simplest(left, declared))
        left = [m for m in left if m is not found[-1]]
    return found


def as_good(model: Model, best: Model, declared: Model) -> bool:
    """Whether a model's errors on left-out blocks are within one standard error of the best model's.

    A model of the body's numerics is never exact, and one more number absorbs some of that: a difference below both
    ``_DISCREPANCY`` of what the best model explains and what it leaves above the noise does not count either.
    """
    if within_noise(model, best):
        return True
    gap, spread = difference(model.validated, best.validated)
    explained = max(declared.validated.mean - best.validated.mean, 0.0)
    remainder = max(best.validated.mean - 1.0, 0.0) + _NOISE_KNOWN
    return gap <= max(spread, min(_DISCREPANCY * explained, remainder))


def within_noise(model: Model, best: Model) -> bool:
    """Whether a model predicts left-out blocks within the noise, where the best one errs clearly less than that.

    Then the noise is declared too large, or it is no noise at all but how well an experiment repeats; what lies below
    it tells no model from another.
    """
    return best.validated.mean < _BELOW_NOISE and model.validated.mean <= 1.0


def richer_and_better(model: Model, best: Model, basis: Array, declared: Model, alike: float) -> bool:
    """Whether another explanation by as many effects predicts better than the simplest of those that are as good.

    By more than a standard error, and more than the noise is known: then it is the discrepancy allowed to a twin that
    calls them as good, not the data, and one number less is no reason to prefer an effect. One that explains the same
    and a little more (a wind beside a drag) is another matter: of the twin's discrepancy more numbers absorb more.

    Args:
        model, best: two models.
        basis: orthonormal directions of the calibrated unknowns, (M, p).
        declared: the declared physics.
        alike: correlation from which two effects count as one.
    """
    gap, spread = difference(best.validated, model.validated)
    same = alikeness(explained_direction(model, declared, basis), explained_direction(best, declared, basis))
    return len(model.members) == len(best.members) and gap > max(spread, _NOISE_KNOWN) and same <= alike


def indistinguishable(model: Model, best: Model, basis: Array, declared: Model, alike: float) -> bool:
    """Whether another model that is no less simple does as well, and by explaining the same.

    As well: within one standard error, or within half of what the better one leaves above the noise, which may as well
    lie between the two as elsewhere. A wind does all that a drag and a tilt do, with a number more: it is they as well
    unless it predicts better beyond chance.

    Args:
        model, best: two models.
        basis: orthonormal directions of the calibrated unknowns, (M, p).
        declared: the declared physics.
        alike: correlation from which two effects count as one.
    """
    if other_names(model, best):
        return whole_of(best) is not None or as_good(model, best, declared) or not beats(best, model)
    if len(model.members) != len(best.members) or len(model.fitted.unknowns) > len(best.fitted.unknowns):
        return False
    same = alikeness(explained_direction(model, declared, basis), explained_direction(best, declared, basis))
    if within_noise(model, best):
        return same > alike
    gap, spread = difference(model.validated, best.validated)
    return same > alike and gap <= max(spread, 0.5 * max(best.fitted.misfit**2 - 1.0, 0.0))
