"""Local stage: fields of stiffness, density and ground friction over the body, on top of a homogeneous fit.

    log factor of a particle = sum_k phi_k z_k        prior z_k ~ N(0, 1)

phi are the leading modes of a Gaussian process over part features (smooth along the body, blind across a gap), without
their mean, with the prior's standard deviation in them; a constant is added, so that the modulus itself may move. What
is minimised over the training frames is

    mean squared error / that of the homogeneous fit + strength * |z|^2

by BFGS with the reverse-mode gradient (:mod:`physworld.twin.gradient`). The modulus itself outweighs
every mode a hundredfold, so the first Hessian is that of Gauss and Newton, from one run a coefficient.

A field of the friction under a body is searched only if the data know it: what they say of its best coefficient, the
others marginalised, is weighed against the prior (:meth:`FieldSearch.known`); else it is held at its prior and reported
so. A few markers do not fix a field either: the strength is chosen on the last part of the training frames, which that
search does not see, and a field that does not beat the homogeneous fit there is thrown away and reported so. Then it is
fitted again on all training frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.local_search import FieldSearch, LocalConfig
from physworld.errors import CalibrationError, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.simulations import Runner, in_turn
from physworld.scene import Scene
from physworld.twin.twin import Twin

_WORTH = 0.9  # of the validation error is what a weaker prior may leave at most
_KNOWN = (
    3.0  # times as precisely as the prior must the data know a field: half of its standard deviation is left
)


@dataclass(frozen=True)
class LocalResult:
    """What the local stage found.

    Attributes:
        properties: log factors of stiffness and density, (P, 2), and of friction where it was searched, (P, 3), for
            :meth:`Twin.simulate`; zero if nothing was kept.
        fields: that were searched.
        held: why others were held at their prior, by name.
        kept: whether the field beat the homogeneous fit on the validation frames.
        strength: chosen strength of the prior, None if nothing was kept.
        validation: mean squared error on the validation frames over the homogeneous fit's, by strength.
        tracks: tracked points over all frames, (T, N, 3) [m].
        runs: forward runs with a gradient.
        simulations: forward runs without one.
        seconds: wall time.
        reason: a sentence.
    """

    properties: Array
    fields: tuple[str, ...]
    held: dict[str, str]
    kept: bool
    strength: float | None
    validation: dict[float, float]
    tracks: Array
    runs: int
    simulations: int
    seconds: float
    reason: str
    modes: Array = field(repr=False, default_factory=lambda: np.empty((0, 0)))


def fit_fields(
    scene: Scene,
    twin: Twin,
    config: LocalConfig | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> LocalResult:
    """Fit fields to the training frames of a scene, on a twin that the global stage has fitted.

    Args:
        scene: the recording.
        twin: the homogeneous fit.
        config: settings; None for the defaults.
        progress: called with (runs done, runs about, what for) before every run.
        cancelled: polled every frame of every run.
        journal: finished steps of an earlier attempt, which are not simulated again.
        runner: where simulations run that do not depend on each other: those of a Hessian.

    Raises:
        CalibrationError: the twin's own run fails, or no training frame is left for the validation.
        Cancelled: ``cancelled`` returned true.
        NotDifferentiable: something that acts on the twin has no derivative.
        ValueError: an unknown field.
    """
    config = config or LocalConfig()
    started = time.perf_counter()
    search = FieldSearch(scene, twin, config, cancelled, progress, journal, runner)
    split = search.split()
    plain = search.errors(np.zeros(search.size), search.end)
    if not np.isfinite(plain).all():
        raise CalibrationError("the homogeneous twin's own run fails: there is nothing to build a field on")
    before = float(plain[: split - search.begin].mean())
    after = float(plain[split - search.begin :].mean())
    held = _unknown(search, split, before)
    if not search.fields:
        return _result(search, np.zeros(0), None, {}, held, started)
    shift, _ = search.descend(np.zeros(search.size), split, before, strength=None)
    reference = min(after, search.validation_error(shift, split))
    validation: dict[float, float] = {}
    best, best_z, z = None, None, shift
    for strength in config.strengths:
        z, _ = search.descend(z, split, before, strength)
        ratio = search.validation_error(z, split) / reference
        validation[strength] = ratio
        if best is None or ratio < _WORTH * validation[best]:  # a weaker prior has to be worth it
            best, best_z = strength, z
    kept = best is not None and validation[best] < 1.0 - config.least_gain
    final = np.zeros(search.size)
    if kept and best_z is not None:
        final, _ = search.descend(best_z, search.end, float(plain.mean()), best)
    reason = (
        f"kept: {1.0 - validation[best]:.0%} less error than the homogeneous fit on frames {split} to {search.end - 1}"
        if kept and best is not None
        else f"thrown away: at best {min(validation.values()):.3f} of the homogeneous fit's error on frames {split} to "
        f"{search.end - 1}, {1.0 - config.least_gain:.2f} was asked"
    )
    try:
        return _result(search, final, best if kept else None, validation, held, started, reason)
    except SimulationError as error:  # of the held-out frames: no search has seen them
        if not kept:
            raise
        reason = f"thrown away: its run over the whole recording fails: {error}"
        return _result(search, np.zeros(search.size), None, validation, held, started, reason)


def _unknown(search: FieldSearch, split: int, variance: float) -> dict[str, str]:
    """Drops what the data do not know, and says why, by name."""
    if "friction" not in search.fields:
        return {}
    known = search.known("friction", split, variance)
    if known >= _KNOWN:
        return {}
    search.drop("friction")
    said = f"the data know its best coefficient {known:.2g} times as precisely as the prior, {_KNOWN:g} times was asked"
    return {"friction": f"not identified, held at its prior: {said}"}


def _result(
    search: FieldSearch,
    final: Array,
    strength: float | None,
    validation: dict[float, float],
    held: dict[str, str],
    started: float,
    reason: str = "nothing to search",
) -> LocalResult:
    scene, twin = search.scene, search.twin
    properties = search.properties(final) if search.fields else np.zeros((len(search.modes), 2))
    times, controls = scene.control_track()
    nodes = twin.simulate_nodes(times, controls, scene.times, properties=properties)
    return LocalResult(
        properties=properties,
        fields=search.fields,
        held=held,
        kept=strength is not None,
        strength=strength,
        validation=validation,
        tracks=twin.observe(nodes, scene.times),
        runs=search.runs,
        simulations=search.simulations,
        seconds=time.perf_counter() - started,
        reason="; ".join([reason, *(f"{name} {why}" for name, why in held.items())]),
        modes=search.modes,
    )
