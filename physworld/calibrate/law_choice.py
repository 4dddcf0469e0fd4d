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

from physworld.calibrate.fibres import free_fibres
from physworld.calibrate.global_stage import (
    CalibrationConfig,
    free_optional,
    prior_twin,
    searched_parameters,
    select,
)
from physworld.calibrate.parameters import WEAVE, Parameter
from physworld.calibrate.search import Optimum, Progress, Search
from physworld.errors import LawAnswerRefused, LawAnswerUnavailable
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

    name: str

    def __call__(self, prompt: str, images: list[bytes]) -> str: ...


@dataclass(frozen=True)
class LawChoice:
    """The record of a choice.

    Attributes:
        elastic, plastic: names in the libraries of laws.
        decided_by: "default", "given", "cross_validation", or "model NAME".
        reason: why, in words.
        figures: held-out error of every candidate in the blocks, and what a model answered.
    """

    elastic: str
    plastic: str = PURELY_ELASTIC
    decided_by: str = "default"
    reason: str = "the usual law of this shape of body"
    figures: dict[str, Any] = field(default_factory=dict)


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
) -> LawChoice:
    """Choose by the model where one is given and answers, else by cross-validation.

    Args:
        scene: only its training frames are used.
        config: settings of the fits.
        ask, images: the model and how the motion is drawn for it (PNG), both or neither.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.

    Raises:
        CalibrationError, Cancelled, SceneUnsupported: see :func:`physworld.calibrate.calibrate`.
    """
    answered: dict[str, Any] = {}
    if ask is not None and images is not None:
        dimension = prior_twin(scene, config).lattice.dim
        try:
            text = ask(PROMPT, images(_training_only(scene)))
            answered = {"asked": ask.name, "answer": text[:_LONGEST_REASON]}
            elastic, plastic, reason = parse_answer(text, dimension)
            return LawChoice(elastic, plastic, f"model {ask.name}", reason, answered)
        except (LawAnswerRefused, LawAnswerUnavailable) as error:
            answered |= {"asked": ask.name, "not_used_because": str(error)}
    choice = cross_validate(scene, config, progress=progress, cancelled=cancelled)
    return replace(choice, figures={**choice.figures, **answered})


def cross_validate(
    scene: Scene,
    config: CalibrationConfig,
    candidates: tuple[str, ...] | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> LawChoice:
    """Choose among laws by their error on blocks of training frames that their fit did not see."""
    config = replace(config, law=None)
    twin = prior_twin(scene, config)
    names = candidates or SIMPLEST_FIRST[twin.lattice.dim]
    if len(names) == 1:
        reason = (
            f"the only law for a body of dimension {twin.lattice.dim} whose constants a calibration searches"
        )
        return LawChoice(names[0], reason=reason)
    search = Search(scene, twin, config.max_simulations, progress, cancelled)
    kept, optimum, _ = select(search, searched_parameters(scene, search.twin, config))
    scores, needless = {}, {}
    for name in names:
        named = replace(config, law=name)
        fitted, at, without = _freed(scene, named, kept, optimum, progress, cancelled)
        if without and len(fitted) == len(kept):
            needless[name] = without
        else:
            scores[name] = _fold_errors(scene, named, fitted, at, progress, cancelled)
    means = {name: float(np.mean(errors)) for name, errors in scores.items()}
    best = min(means, key=lambda name: means[name])
    spread = float(np.std(scores[best], ddof=1) / np.sqrt(FOLDS))
    chosen = next(name for name in names if name in means and means[name] <= means[best] + spread)
    figures = {
        "held_out_rms_m": {
            name: {"mean": means[name], "blocks": list(errors)} for name, errors in scores.items()
        },
        "standard_error_m": spread,
        "needless_constants": needless,
    }
    reason = (
        f"least error on {FOLDS} blocks of training frames that its fit did not see"
        if chosen == best
        else f"the simplest within one standard error ({spread:.3g} m) of {best}: these data do not tell them apart"
    )
    return LawChoice(chosen, decided_by="cross_validation", reason=reason, figures=figures)


def _freed(
    scene: Scene,
    config: CalibrationConfig,
    kept: list[Parameter],
    optimum: Optimum,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
) -> tuple[list[Parameter], Optimum, dict[str, float]]:
    """What a law has more than the usual one, freed on all training frames, and what it has that removes too little."""
    search = Search(scene, prior_twin(scene, config), config.max_simulations, progress, cancelled)
    parameters = searched_parameters(scene, search.twin, config)
    fibres = [p for p in parameters if p.stage == "fibres"]
    with_fibres, at, without = free_fibres(search, kept, optimum, fibres)
    weave = [p for p in parameters if p.name in WEAVE]
    found, at, more = free_optional(search, with_fibres, at, weave)
    return found, at, {**without, **more}


def _fold_errors(
    scene: Scene,
    config: CalibrationConfig,
    kept: list[Parameter],
    optimum: Optimum,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
) -> list[float]:
    """Root mean squared error [m] on each block after a fit to the others; infinite where a run blew up."""
    frames = np.array_split(np.arange(max(scene.train[0], 1), scene.train[1]), FOLDS)
    errors = []
    for block in frames:
        left_out = np.zeros(scene.frame_count, dtype=bool)
        left_out[block] = True
        seen = replace(scene, visible=scene.visible & (~left_out)[:, None])
        unseen = replace(scene, visible=scene.visible & left_out[:, None])
        if not seen.visible[1:].any() or not unseen.visible.any():
            continue
        twin = prior_twin(scene, config)
        fold = Search(seen, twin, config.max_simulations, progress, cancelled)
        found = fold.solve(kept, optimum.theta, 2)
        judged = Search(unseen, twin, config.max_simulations, None, cancelled).residual(kept, found.theta)
        square = float(np.mean(judged**2))
        errors.append(float(np.sqrt(square)) if np.isfinite(square) else float("inf"))
    return errors


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
