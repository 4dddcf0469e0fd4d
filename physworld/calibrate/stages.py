"""The paper's global-to-local calibration: homogeneous parameters first, then a field on top of them if it holds.

The local stage (:mod:`physworld.calibrate.local_stage`) judges its field on the last part of the training frames, which
the search of it does not see; a field that does not hold there is thrown away, and the twin stays the homogeneous one.
A field that is kept belongs to the twin: whatever runs it later carries it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from physworld.calibrate.estimates import training_losses
from physworld.calibrate.global_stage import CalibrationConfig, FitResult, calibrate, prior_twin
from physworld.calibrate.local_search import LocalConfig
from physworld.calibrate.local_stage import LocalResult, fit_fields
from physworld.calibrate.search import Progress
from physworld.errors import CalibrationError, NotDifferentiable, SceneUnsupported
from physworld.estimation.journal import Journal
from physworld.estimation.simulations import Runner, in_turn
from physworld.scene import Scene

Stages = Literal["global", "global+local"]
GLOBAL: Stages = "global"


def calibrate_in_stages(
    scene: Scene | Sequence[Scene],
    config: CalibrationConfig | None = None,
    stages: Stages = GLOBAL,
    local: LocalConfig | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> FitResult:
    """Fit a twin to the training frames of ``scene``, and a field over its body where that is asked for.

    Args:
        scene: the recording, or several of one object; a field is fitted to one.
        config: settings of the global stage; None for the defaults.
        stages: "global", or "global+local".
        local: settings of the local stage; None for the defaults.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.
        runner: where simulations run that do not depend on each other.
        journal: finished steps of an earlier attempt; one of the global stage alone is gone on from.

    Raises:
        CalibrationError, Cancelled, SceneUnsupported, ValueError: see :func:`physworld.calibrate.calibrate`; also
            SceneUnsupported for a field over a body without a gradient (of the updated Lagrangian form, or a mesh of
            triangles) or to several recordings, and ValueError for unknown stages.
    """
    config = config or CalibrationConfig()
    if stages not in get_args(Stages):
        raise ValueError(f"no stages {stages!r}; there are {get_args(Stages)}")
    if stages == GLOBAL:
        return calibrate(scene, config, progress, cancelled, journal, runner)
    scenes = [scene] if isinstance(scene, Scene) else scene
    if len(scenes) != 1:
        raise SceneUnsupported(f"the local stage fits a field to one recording; these are {len(scenes)}")
    return _with_field(scenes[0], config, local, progress, cancelled, journal, runner)


def _with_field(
    scene: Scene,
    config: CalibrationConfig,
    local: LocalConfig | None,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    journal: Journal | None,
    runner: Runner,
) -> FitResult:
    """The global stage of one recording, then a field on top of it."""
    prior = prior_twin(scene, config)
    form = prior.form
    if not prior.lattice.smooth:
        raise SceneUnsupported(f"the local stage needs gradients, which {prior.lattice.title} lacks")
    if not form.supports("gradients"):
        raise SceneUnsupported(
            f"the local stage needs the total Lagrangian form, whose runs have a gradient; this body is of the "
            f"{form.title} one"
        )
    fitted = calibrate(scene, config, progress, cancelled, journal, runner)

    def after(done: int, total: int, message: str) -> None:
        if progress is not None:
            progress(fitted.simulations + done, fitted.simulations + total, message)

    try:
        found = fit_fields(scene, fitted.twin, local, after, cancelled, journal, runner)
    except (CalibrationError, NotDifferentiable) as error:
        return replace(fitted, local=_not_searched(fitted, error))
    if not found.kept:
        return replace(fitted, local=found)
    twin = replace(fitted.twin, properties=found.properties)
    nodes = twin.simulate_nodes(*scene.control_track(), scene.times)
    tracks = twin.observe(nodes, scene.times)
    return replace(
        fitted,
        twin=twin,
        tracks=tracks,
        particles=twin.particles_at(nodes),
        losses=training_losses(scene, tracks),
        seconds=fitted.seconds + found.seconds,
        local=found,
        homogeneous=fitted.tracks,
    )


def _not_searched(fitted: FitResult, error: Exception) -> LocalResult:
    """The record of a local stage that could not begin."""
    return LocalResult(
        properties=np.zeros((len(fitted.twin.particles_rest), 2)),
        fields=(),
        held={},
        kept=False,
        strength=None,
        validation={},
        tracks=fitted.tracks,
        runs=0,
        simulations=0,
        seconds=0.0,
        reason=f"not searched: {error}",
    )
