"""Which constitutive law a body gets, and who decided it on what figures.

(a) *Cross-validation.* Every candidate whose further constants (fibres; weft and shear of a sheet) the data ask for is
fitted to all but one block of the training frames and measured on the block
that was left out, open loop; of those within one standard error of the best, the simplest is taken (Breiman et al.
1984, section 3.4.3). The blocks are few, so this names a law only where it matters, and the simplest one otherwise.

(b) *A vision-language model.* It sees pictures of the motion and the paper's prompt (appendix, "VLM-assisted
constitutive model selection") and answers in one line, ``Elastic: ... | Plastic: ... | Reason: ...``. How it is reached
is the caller's business (:class:`Ask`). An answer that is not of that form, names no law of the library, or does not
come, is recorded with its reason and (a) decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from physworld.calibrate.descents import Descent, Optimum, residuals_apart, solve_apart
from physworld.calibrate.fibres import free_fibres
from physworld.calibrate.global_stage import (
    CalibrationConfig,
    free_optional,
    prior_twin,
    searched_parameters,
    select,
)
from physworld.calibrate.parameters import WEAVE, Parameter
from physworld.calibrate.search import Progress, Search
from physworld.errors import LawAnswerRefused, LawAnswerUnavailable, SceneUnsupported
from physworld.estimation.journal import Journal
from physworld.estimation.simulations import Runner, in_turn
from physworld.scene import Scene

PROMPT = """Analyze the video of object-hand interaction and recommend optimal MPM constitutive models from the following library:
- Elastic Models: FCR, Neo-Hookean, St. Venant-Kirchhoff, Anisotropic Hyperelastic
- Plastic Models: Von Mises, Drucker-Prager, St. Venant-Kirchhoff, Purely Elastic
Provide recommendations in the format:
Elastic: [model] | Plastic: [model] | Reason: [justification]"""  # noqa: E501 - the paper's words

FOLDS = 3
SIMPLEST_FIRST = {
    3: ("neo_hookean", "fixed_corotated", "st_venant_kirchhoff", "hencky", "transversely_isotropic"),
    2: ("isotropic_sheet", "orthotropic_sheet"),
    1: ("rod",),
}
"""Candidates of the cross-validation by dimension: laws with the same constants, the usual one first, then those with
more; these are fitted to the blocks only if all training frames together ask for what they have more."""

PURELY_ELASTIC = "identity"
_PLASTIC = {
    "vonmises": "von_mises",
    "druckerprager": "drucker_prager",
    "stvenantkirchhoff": "st_venant_kirchhoff",
    "purelyelastic": PURELY_ELASTIC,
}
_ELASTIC = {
    3: {
        "fcr": "fixed_corotated",
        "fixedcorotated": "fixed_corotated",
        "neohookean": "neo_hookean",
        "stvenantkirchhoff": "st_venant_kirchhoff",
        "anisotropichyperelastic": "transversely_isotropic",
    },
    2: {"anisotropichyperelastic": "orthotropic_sheet"},
    1: {},
}
_ANSWER = re.compile(
    r"^\W*elastic:\s*([^|]+?)\s*\|\s*plastic:\s*([^|]+?)\s*\|\s*reason:\s*(\S.*?)\s*$", re.IGNORECASE
)
_LONGEST_REASON = 1000


class Ask(Protocol):
    """A vision-language model: a prompt and PNG images in, its text out. Raises LawAnswerUnavailable."""

    @property
    def name(self) -> str: ...

    def __call__(self, prompt: str, images: list[bytes]) -> str: ...


@dataclass(frozen=True)
class LawChoice:
    """The record of a choice.

    Attributes:
        elastic, plastic: names in the libraries of laws.
        decided_by: "default", "given", "cross_validation", or "model NAME".
        reason: why, in words.
        figures: held-out error of every candidate in the blocks, and what a model answered.
        ended: whether the fits behind it ended by themselves; else the reason says that their budget was spent.
    """

    elastic: str
    plastic: str = PURELY_ELASTIC
    decided_by: str = "default"
    reason: str = "the usual law of this shape of body"
    figures: dict[str, Any] = field(default_factory=dict)
    ended: bool = True


def parse_answer(text: str, dimension: int) -> tuple[str, str, str]:
    """(elastic, plastic, reason) of a model's answer, with our names of the laws.

    A model may think aloud before: exactly one line must be an answer.

    Raises:
        LawAnswerRefused: no line or several lines are an answer, or a name is not in the library.
    """
    answers = [found for line in text.splitlines() if (found := _ANSWER.match(line.strip()))]
    if len(answers) != 1:
        raise LawAnswerRefused(
            f"{len(answers)} lines of the form 'Elastic: … | Plastic: … | Reason: …' in {_short(text)}"
        )
    elastic, plastic, reason = answers[0].groups()
    known = _ELASTIC[dimension]
    if _key(elastic) not in known:
        raise LawAnswerRefused(f"{_short(elastic)} is no elastic law of a body of dimension {dimension}")
    if _key(plastic) not in _PLASTIC:
        raise LawAnswerRefused(f"{_short(plastic)} is no plastic law")
    return known[_key(elastic)], _PLASTIC[_key(plastic)], reason[:_LONGEST_REASON]


def choose_law(
    scene: Scene,
    config: CalibrationConfig,
    ask: Ask | None = None,
    images: Callable[[Scene], list[bytes]] | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    runner: Runner = in_turn,
    journal: Journal | None = None,
) -> LawChoice:
    """Choose by the model where one is given and answers, else by cross-validation.

    Args:
        scene: only its training frames are used.
        config: settings of the fits.
        ask, images: the model and how the motion is drawn for it (PNG), both or neither.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.
        runner: where simulations of the cross-validation run that do not depend on each other.
        journal: keeps what a model answered and the finished steps of the fits; a choice that was cut off goes on.

    Raises:
        CalibrationError, Cancelled, SceneUnsupported: see :func:`physworld.calibrate.calibrate`.
    """
    journal = journal or Journal()
    answered: dict[str, Any] = {}
    if ask is not None and images is not None:
        dimension = prior_twin(scene, config).lattice.dim
        said = journal.step("asked", lambda: _asked(ask, images(_training_only(scene))))
        try:
            if said["unavailable"] is not None:
                raise LawAnswerUnavailable(said["unavailable"])
            text = said["text"]
            answered = {"asked": ask.name, "answer": text[:_LONGEST_REASON]}
            elastic, plastic, reason = parse_answer(text, dimension)
            _refuse_unbuildable(scene, config, elastic, plastic)
            return LawChoice(elastic, plastic, f"model {ask.name}", reason, answered)
        except (LawAnswerRefused, LawAnswerUnavailable) as error:
            answered |= {"asked": ask.name, "not_used_because": str(error)}
    choice = cross_validate(
        scene, config, progress=progress, cancelled=cancelled, runner=runner, journal=journal
    )
    return replace(choice, figures={**choice.figures, **answered})


def _asked(ask: Ask, images: list[bytes]) -> dict[str, str | None]:
    """What a model said, or why it said nothing."""
    try:
        return {"text": ask(PROMPT, images), "unavailable": None}
    except LawAnswerUnavailable as error:
        return {"text": None, "unavailable": str(error)}


def _refuse_unbuildable(scene: Scene, config: CalibrationConfig, elastic: str, plastic: str) -> None:
    """Whether a body of this scene can have these laws under these settings. Raises LawAnswerRefused."""
    flow = config.plasticity or (None if plastic == PURELY_ELASTIC else plastic)
    try:
        prior_twin(scene, replace(config, law=elastic, plasticity=flow))
    except (SceneUnsupported, ValueError) as error:
        raise LawAnswerRefused(f"{elastic} with {plastic}: {error}") from error


def cross_validate(
    scene: Scene,
    config: CalibrationConfig,
    candidates: tuple[str, ...] | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    runner: Runner = in_turn,
    journal: Journal | None = None,
) -> LawChoice:
    """Choose among laws by their error on blocks of training frames that their fit did not see.

    Args:
        scene: only its training frames are used.
        config: settings of the fits.
        candidates: names of laws, the simplest first; None for those of the body's dimension.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.
        runner: where simulations run.
        journal: keeps the finished steps of the fits.
    """
    config, journal = replace(config, law=None), journal or Journal()
    twin = prior_twin(scene, config)
    names = candidates or SIMPLEST_FIRST[twin.lattice.dim]
    if len(names) == 1:
        reason = (
            f"the only law for a body of dimension {twin.lattice.dim} whose constants a calibration searches"
        )
        return LawChoice(names[0], reason=reason)
    blocks = _blocks(scene)
    if len(blocks) < 2:
        reason = (
            f"too few training frames show anything to hold some of them out: {names[0]} is the usual law"
        )
        return LawChoice(names[0], reason=reason)
    search = Search(scene, twin, config.max_simulations, progress, cancelled, journal, runner)
    kept, optimum, _ = select(search, searched_parameters(scene, search.twin, config))
    fits, needless = {}, {}
    ended = not search.cut_short
    for name in names:
        named = replace(config, law=name)
        own = Search(
            scene, prior_twin(scene, named), config.max_simulations, progress, cancelled, journal, runner
        )
        fitted, at, without = _freed(own, named, kept, optimum)
        ended &= not own.cut_short
        if without and len(fitted) == len(kept):
            needless[name] = without
        else:
            fits[name] = (named, fitted, at)
    measured = journal.step(
        "blocks of a choice", lambda: _block_errors(scene, blocks, fits, progress, cancelled, runner)
    )
    ended &= not measured["cut_short"]
    spent = (
        ""
        if ended
        else f"; fits behind the choice were cut short by their budget of {config.max_simulations} simulations"
    )
    scores = {
        name: [float("inf") if one is None else one for one in errors]
        for name, errors in measured["errors"].items()
    }
    means = {name: float(np.mean(errors)) for name, errors in scores.items()}
    best = min(means, key=lambda name: means[name])
    figures: dict[str, Any] = {
        "held_out_rms_m": {
            name: {"mean": means[name], "blocks": list(errors)} for name, errors in scores.items()
        },
        "standard_error_m": None,
        "needless_constants": needless,
    }
    if not np.isfinite(means[best]):
        reason = (
            f"no law's simulations hold on all {len(blocks)} blocks of training frames: it is the usual one"
        )
        return LawChoice(names[0], reason=reason + spent, figures=figures, ended=ended)
    spread = float(np.std(scores[best], ddof=1) / np.sqrt(len(blocks)))
    chosen = next(name for name in names if name in means and means[name] <= means[best] + spread)
    reason = (
        f"least error on {len(blocks)} blocks of training frames that its fit did not see"
        if chosen == best
        else f"the simplest within one standard error ({spread:.3g} m) of {best}: these data do not tell them apart"
    )
    figures["standard_error_m"] = spread
    return LawChoice(
        chosen, decided_by="cross_validation", reason=reason + spent, figures=figures, ended=ended
    )


def _freed(
    search: Search, config: CalibrationConfig, kept: list[Parameter], optimum: Optimum
) -> tuple[list[Parameter], Optimum, dict[str, float]]:
    """What a law has more than the usual one, freed on all training frames, and what it has that removes too little."""
    parameters = searched_parameters(search.scene, search.twin, config)
    fibres = [p for p in parameters if p.stage == "fibres"]
    with_fibres, at, without = free_fibres(search, kept, optimum, fibres)
    weave = [p for p in parameters if p.name in WEAVE]
    found, at, more = free_optional(search, with_fibres, at, weave)
    return found, at, {**without, **more}


def _blocks(scene: Scene) -> list[tuple[Scene, Scene]]:
    """What a fit sees and what it is measured on, block by block of the training frames; only where both see points."""
    first, end = max(scene.train[0], 1), scene.train[1]
    found = []
    for block in np.array_split(np.arange(first, end), FOLDS):
        left_out = np.zeros(scene.frame_count, dtype=bool)
        left_out[block] = True
        seen = replace(scene, visible=scene.visible & (~left_out)[:, None])
        unseen = replace(scene, visible=scene.visible & left_out[:, None])
        if seen.visible[first:end].any() and unseen.visible.any():
            found.append((seen, unseen))
    return found


def _block_errors(
    scene: Scene,
    blocks: list[tuple[Scene, Scene]],
    fits: dict[str, tuple[CalibrationConfig, list[Parameter], Optimum]],
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    runner: Runner,
) -> dict[str, Any]:
    """``errors``: [m] (rms) of every law on each block after a fit to the others, infinite where a run blew up.

    ``cut_short``: whether the budget ended one of these fits.
    """
    asked: list[tuple[Search, Descent]] = []
    judges: list[Search] = []
    for config, kept, optimum in fits.values():
        twin = prior_twin(scene, config)
        for seen, unseen in blocks:
            fold = Search(seen, twin, config.max_simulations, progress, cancelled, runner=runner)
            asked.append((fold, Descent(kept, optimum.theta, 2)))
            judges.append(Search(unseen, twin, config.max_simulations, None, cancelled, runner=runner))
    found = solve_apart(asked)
    judged = residuals_apart(
        [
            (judge, (one.parameters, optimum.theta, None))
            for judge, (_, one), optimum in zip(judges, asked, found, strict=True)
        ]
    )
    squares = [float(np.mean(residual**2)) for residual in judged]
    errors = iter([float(np.sqrt(square)) if np.isfinite(square) else float("inf") for square in squares])
    return {
        "errors": {name: [next(errors) for _ in blocks] for name in fits},
        "cut_short": any(fold.cut_short for fold, _ in asked),
    }


def _training_only(scene: Scene) -> Scene:
    frames = slice(0, scene.train[1])
    return replace(
        scene,
        points=scene.points[frames],
        visible=scene.visible[frames],
        controllers=scene.controllers[frames],
        times=scene.times[frames],
    )


def _key(name: str) -> str:
    """A law's name without case, brackets and punctuation: "St.~Venant-Kirchhoff" is "stvenantkirchhoff"."""
    return re.sub(r"[^a-z]", "", name.lower())


def _short(text: str) -> str:
    flat = " ".join(text.split())
    return repr(flat if len(flat) <= 120 else flat[:117] + "...")
