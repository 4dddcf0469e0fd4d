"""The choice of a law: the paper's answer format, and what cross-validation makes of recordings whose law is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by
from test_shared_search import Together

from physworld.calibrate import CalibrationConfig, Journal, law_choice
from physworld.calibrate.law_choice import PROMPT, choose_law, cross_validate, parse_answer
from physworld.errors import Cancelled, LawAnswerRefused, LawAnswerUnavailable
from physworld.estimation.simulations import Drive, Job, in_turn
from physworld.materials.library import with_law
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.02, -0.02]), np.array([0.16, 0.02, 0.02])
CONFIG = CalibrationConfig(particle_budget=64, max_simulations=60, damping="none")
ANSWER = "Elastic: St. Venant-Kirchhoff | Plastic: Purely Elastic | Reason: large rotations, small strains"


def drooping_block(law: str, modulus: float, sigma: float = 2e-4) -> Scene:
    """A soft block that droops far from its clamp, recorded by a twin of the given law."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[x, y, 0.02] for x in np.linspace(0.04, 0.16, 6) for y in (-0.02, 0.02)],
        "beam",
        grip,
        24,
        body=box_body(LOW, HIGH, density_kg_m3=1000.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.03, 0.02, 0.02])),),
        initial_state=UNDEFORMED_AT_REST,
    )
    twin = build_twin(scene, CONFIG.particle_budget).with_parameters(youngs_modulus_pa=modulus)
    return recorded_by(replace(twin, law=with_law(twin.law, law)), scene, sigma)


class Says:
    """A model that gives one answer, or none."""

    name = "parrot"

    def __init__(self, text: str | None) -> None:
        self.text, self.prompts, self.images = text, [], []

    def __call__(self, prompt: str, images: list[bytes]) -> str:
        self.prompts.append(prompt)
        self.images.append(images)
        if self.text is None:
            raise LawAnswerUnavailable("the line is dead")
        return self.text


@pytest.mark.parametrize(
    ("text", "law"),
    [
        (ANSWER, "st_venant_kirchhoff"),
        ("Let me think.\n\n**Elastic: FCR | Plastic: Von Mises | Reason: it dents", "fixed_corotated"),
        ("elastic: Neo-Hookean|plastic: purely elastic|reason: rubber", "neo_hookean"),
        ("Elastic: St.~Venant--Kirchhoff | Plastic: Drucker-Prager | Reason: x", "st_venant_kirchhoff"),
    ],
)
def test_answers_of_the_asked_form_are_understood(text: str, law: str) -> None:
    assert parse_answer(text, 3)[0] == law


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "0 lines"),
        ("I would choose Neo-Hookean.", "0 lines"),
        ("Elastic: Neo-Hookean | Plastic: Von Mises", "0 lines"),
        ("Elastic: Neo-Hookean | Plastic: Von Mises | Reason:", "0 lines"),
        (f"{ANSWER}\n{ANSWER}", "2 lines"),
        ("Elastic: Jelly | Plastic: Von Mises | Reason: wobbles", "'Jelly' is no elastic law"),
        ("Elastic: [model] | Plastic: [model] | Reason: [justification]", "no elastic law"),
        ("Elastic: FCR | Plastic: Wax | Reason: melts", "'Wax' is no plastic law"),
    ],
)
def test_any_other_answer_is_refused_with_its_words(text: str, word: str) -> None:
    with pytest.raises(LawAnswerRefused, match=word):
        parse_answer(text, 3)


def test_cloth_is_anisotropic_in_the_library_s_own_words() -> None:
    text = "Elastic: Anisotropic Hyperelastic | Plastic: Purely Elastic | Reason: woven"
    assert (
        parse_answer(text, 2)[0] == "orthotropic_sheet"
        and parse_answer(text, 3)[0] == "transversely_isotropic"
    )
    with pytest.raises(LawAnswerRefused):
        parse_answer(ANSWER, 2)  # a volumetric law is none of a sheet


def test_a_model_that_answers_decides_and_sees_only_training_frames() -> None:
    scene = drooping_block("neo_hookean", 3e4)
    seen: list[int] = []

    def images(shown: Scene) -> list[bytes]:
        seen.append(shown.frame_count)
        return [b"png"]

    model = Says(ANSWER)
    choice = choose_law(scene, CONFIG, model, images)
    assert (choice.elastic, choice.plastic) == ("st_venant_kirchhoff", "identity")
    assert choice.decided_by == "model parrot" and choice.reason == "large rotations, small strains"
    assert model.prompts == [PROMPT] and model.images == [[b"png"]] and seen == [scene.train[1]]


@pytest.mark.parametrize("text", [None, "Elastic: maybe rubber"])
def test_without_a_usable_answer_the_data_decide_and_the_record_says_why(text: str | None) -> None:
    choice = choose_law(drooping_block("neo_hookean", 2e5), CONFIG, Says(text), lambda scene: [])
    assert choice.decided_by == "cross_validation"
    assert choice.figures["asked"] == "parrot"
    assert ("the line is dead" if text is None else "0 lines") in choice.figures["not_used_because"]


def test_cross_validation_finds_the_law_where_strains_are_large() -> None:
    scene = drooping_block("st_venant_kirchhoff", 7e3, 1e-4)
    choice = cross_validate(scene, CONFIG, ("neo_hookean", "st_venant_kirchhoff"))
    errors = {name: score["mean"] for name, score in choice.figures["held_out_rms_m"].items()}
    assert choice.elastic == "st_venant_kirchhoff" and choice.decided_by == "cross_validation"
    assert errors["st_venant_kirchhoff"] < 0.8 * errors["neo_hookean"]


def test_cross_validation_takes_the_simplest_where_strains_are_small() -> None:
    choice = cross_validate(drooping_block("hencky", 2e6), CONFIG, ("neo_hookean", "hencky"))
    assert choice.elastic == "neo_hookean"


def test_a_rope_has_one_law() -> None:
    rope = made_scene([[x, 0.0, 0.0] for x in np.linspace(0, 0.3, 7)], "rope")
    choice = cross_validate(rope, CONFIG)
    assert choice.elastic == "rod" and "only law" in choice.reason


def test_a_shared_cross_validation_is_the_same_and_its_folds_go_side_by_side() -> None:
    scene, laws = drooping_block("hencky", 2e5), ("neo_hookean", "fixed_corotated", "hencky")
    together = Together()
    assert cross_validate(scene, CONFIG, laws, runner=together) == cross_validate(scene, CONFIG, laws)
    assert together.widths.count(9) > 3  # three laws on three blocks


@pytest.mark.parametrize("hidden", ["frames", "points"])
def test_what_shows_too_little_to_hold_some_of_it_out_gets_the_usual_law(hidden: str) -> None:
    scene = drooping_block("neo_hookean", 2e5)
    if hidden == "frames":
        scene = replace(scene, train=(0, 2))
    else:
        shown = np.isin(np.arange(24), [1, 2, 3, 20, 21, 22])  # of the training frames only one block
        scene = replace(scene, visible=scene.visible & shown[:, None])
    choice = cross_validate(scene, CONFIG)
    assert (choice.elastic, choice.decided_by) == ("neo_hookean", "default") and "too few" in choice.reason


def test_where_no_law_runs_through_on_a_block_the_usual_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(law_choice, "residuals_apart", lambda asked: [np.full(3, np.nan) for _ in asked])
    choice = cross_validate(drooping_block("hencky", 2e5), CONFIG, ("neo_hookean", "hencky"))
    assert (choice.elastic, choice.decided_by) == ("neo_hookean", "default") and "no law" in choice.reason


def test_a_model_that_names_a_flow_which_the_body_cannot_have_does_not_decide() -> None:
    points = [[x, y, 0.0] for x in np.linspace(0, 0.2, 5) for y in np.linspace(0, 0.2, 5)]
    sheet = made_scene(points, "cloth", points[:5], 12)
    text = "Elastic: Anisotropic Hyperelastic | Plastic: Von Mises | Reason: it creases"
    choice = choose_law(sheet, replace(CONFIG, max_simulations=4), Says(text), lambda scene: [])
    assert choice.plastic == "identity" and choice.decided_by != "model parrot"
    assert "updated Lagrangian" in choice.figures["not_used_because"]


def test_a_choice_that_was_cut_off_goes_on_where_it_was() -> None:
    scene, texts, jobs = drooping_block("neo_hookean", 3e4), [], []

    def counting(asked: list[Job], drive: Drive, poll: Callable[..., None]) -> Iterator[np.ndarray | None]:
        jobs.append(len(asked))
        return in_turn(asked, drive, poll)

    laws = ("neo_hookean", "hencky")
    whole = cross_validate(scene, CONFIG, laws, runner=counting)
    took = sum(jobs)
    jobs.clear()
    with pytest.raises(Cancelled):
        cross_validate(
            scene,
            CONFIG,
            laws,
            None,
            lambda: sum(jobs) > 0.7 * took,
            counting,
            Journal("k", None, texts.append),
        )
    assert texts
    jobs.clear()
    again = cross_validate(scene, CONFIG, laws, runner=counting, journal=Journal("k", texts[-1]))
    assert again == whole and 0 < sum(jobs) < 0.6 * took
    jobs.clear()
    asked = Says(ANSWER)
    said = choose_law(scene, CONFIG, asked, lambda scene: [b"png"], journal=Journal("m", None, texts.append))
    kept = choose_law(scene, CONFIG, Says(None), lambda scene: [b"png"], journal=Journal("m", texts[-1]))
    assert kept.elastic == said.elastic == "st_venant_kirchhoff" and len(asked.prompts) == 1 and not jobs
