"""The laws that a fit takes: as the caller names them, or chosen by a model behind PHYSWORLD_LAW_URL or by the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from physworld.calibrate import CalibrationConfig, Journal
from physworld.calibrate.global_stage import prior_twin
from physworld.calibrate.law_choice import PURELY_ELASTIC, LawChoice, choose_law
from physworld.calibrate.search import Progress
from physworld.estimation.simulations import Runner, in_turn
from physworld.scene import Scene
from physworld_workers.law_endpoint import law_endpoint
from physworld_workers.motion_picture import motion_pictures

AUTO = "auto"


def chosen_laws(
    asked: str | None,
    scene: Scene,
    config: CalibrationConfig,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> tuple[CalibrationConfig, LawChoice]:
    """The configuration with its laws, and the record of who chose them.

    Args:
        asked: elastic law by name, "auto" to have it chosen, or None for the usual one.
        scene: the recording; a choice sees its training frames.
        config: the calibration's settings; its flow law, if it has one, is the caller's and stays.
        progress, cancelled: see :func:`physworld.calibrate.calibrate`.
        journal: keeps the steps of a choice for a later attempt.
        runner: where simulations of a choice run that do not depend on each other.

    Raises:
        ValueError: there is no such law for the body.
        CalibrationError, Cancelled, SceneUnsupported: see :func:`physworld.calibrate.calibrate`.
    """
    if asked == AUTO:
        choice = choose_law(
            scene, config, law_endpoint(), motion_pictures, progress, cancelled, runner, journal or Journal()
        )
        plastic = None if choice.plastic == PURELY_ELASTIC else choice.plastic
        return replace(config, law=choice.elastic, plasticity=config.plasticity or plastic), choice
    config = replace(config, law=asked)
    plastic = config.plasticity or PURELY_ELASTIC
    law = prior_twin(scene, config).law.name
    if asked is None and config.plasticity is None:
        return config, LawChoice(law)
    return config, LawChoice(law, plastic, "given", "named by the caller")
