"""What a fit takes a sheet as: a plate, the mesh that the caller names, or the one that its first frames show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate_in_stages
from physworld.calibrate.search import Progress
from physworld.calibrate.stages import GLOBAL, Stages
from physworld.engine.thin.triangles import Mesh, mesh_of
from physworld.estimation.simulations import Drive, Runner, in_turn
from physworld.scene import Scene
from physworld.trace.meshes import recorded_as
from physworld.trace.simulations import Simulations
from physworld.twin.twin import Twin

AUTO, PLATE = "auto", "plate"
_MISFIT = "chi2_per_residual"
_USUAL = "isotropic_sheet"  # hinges have no other bending


def fitted_as_recorded(
    asked: str | None,
    scene: Scene,
    config: CalibrationConfig,
    stages: Stages,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> FitResult:
    """The fit of a sheet as a plate (None), as a mesh by its name ("16x15"), or as what follows the recording better.

    "auto" fits the plate first and asks as a trace does (ADR 21) whether one of the meshes whose lines lie on the ends
    of the grips follows the first frames better; that is fitted too, and of the two the one with the smaller training
    misfit is taken. A body that is no such sheet, or is asked for with other physics, is fitted as without it.

    Args:
        asked: None or "plate", a mesh as :meth:`physworld.engine.thin.triangles.Mesh.read` takes it, or "auto".
        config: settings of the calibration; its mesh is replaced.
        stages, progress, cancelled, journal, runner: of :func:`physworld.calibrate.calibrate_in_stages`.

    Raises:
        ValueError: the text is no mesh; or "auto" with a local stage, whose gradients a mesh lacks.
        CalibrationError, Cancelled, SceneUnsupported: see :func:`physworld.calibrate.calibrate_in_stages`.
    """
    if asked == AUTO and stages != GLOBAL:
        raise ValueError(f"stages {stages!r} need gradients, which the mesh that 'auto' may find lacks")
    mesh = named_mesh(asked)
    journal = journal or Journal()
    first = calibrate_in_stages(
        scene, replace(config, mesh=mesh), stages, None, progress, cancelled, journal, runner
    )
    usual = config.law in (None, _USUAL) and config.plasticity is None and config.formulation == "auto"
    if asked != AUTO or not usual:
        return first
    found = journal.step(
        "mesh of the recorder",
        lambda: {"mesh": _recorder(scene, first.twin, progress, cancelled, runner)},
    )["mesh"]
    if found is None:
        return first
    own = replace(config, mesh=Mesh.read(found))
    other = calibrate_in_stages(scene, own, stages, None, progress, cancelled, journal, runner)
    best = min((first, other), key=lambda fitted: float(fitted.losses[_MISFIT]))
    spent = f"the fit that it was weighed against was cut short by its budget of {config.max_simulations} simulations"
    unsure = (first.cut_short or other.cut_short) and not best.cut_short
    return replace(
        best,
        simulations=first.simulations + other.simulations,
        seconds=first.seconds + other.seconds,
        open={**best.open, **({"mesh": spent} if unsure else {})},
    )


def named_mesh(asked: str | None) -> Mesh | None:
    """The mesh that a caller names; None for a plate (also None) and for "auto". Raises ValueError."""
    return None if asked in (None, AUTO, PLATE) else Mesh.read(str(asked))


def _recorder(
    scene: Scene,
    plate: Twin,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    runner: Runner,
) -> str | None:
    """The mesh that follows the first frames better than the plate, as people write it; None where none does."""
    simulations = Simulations(Drive(*scene.control_track(), scene.times), runner, None, progress, cancelled)
    bodies = recorded_as(scene, plate, simulations, scene.train[1])
    mesh = next((known for body in bodies if (known := mesh_of(body.lattice)) is not None), None)
    return None if mesh is None else mesh.spelled
