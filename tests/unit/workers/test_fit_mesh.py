"""A fit of a sheet as the mesh that recorded it: asked for in a request, calibrated, and not asked for finer cells."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from benchmarks.peers.flex_cloths import Mesh as Recorder
from benchmarks.peers.flex_sheet import record
from physworld.calibrate import CalibrationConfig, calibrate, calibrate_in_stages
from physworld.calibrate.global_stage import prior_twin, searched_parameters
from physworld.engine.thin.triangles import Mesh
from physworld.errors import SceneUnsupported
from physworld_schemas.fit import FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig
from physworld_workers.tasks.fit_accuracy import fit_accuracy
from physworld_workers.tasks.trace import translate


def test_a_request_names_a_mesh_or_is_refused() -> None:
    assert FitConfig(mesh="16x15").mesh == "16x15" and FitConfig(mesh="8x9odd").usual_physics
    for wrong in ("auto", "16", "0x4", "16x15 ", "16 x 15", "1000x4"):
        with pytest.raises(ValidationError, match="mesh"):
            FitConfig(mesh=wrong)
    with pytest.raises(ValidationError, match="gradients, which mesh 4x4 lacks"):
        FitConfig(mesh="4x4", stages="global+local")
    assert FitConfig(mesh="250x200odd").mesh == "250x200odd"
    with pytest.raises(ValidationError, match="mesh 999x999 has 3992004 particles; 200000 are the most"):
        FitConfig(mesh="999x999")
    meshed = FitConfig(mesh="4x4")
    assert PipelineCreate(scene_id="scn", fit=meshed, close_the_loop=True).fit.mesh == "4x4"
    assert translate(meshed, TraceConfig(), "cpu").calibration.mesh == Mesh((4, 4))


def test_a_field_over_a_mesh_is_refused_before_anything_is_simulated() -> None:
    told: list[int] = []
    with pytest.raises(SceneUnsupported, match="56 cells of triangles lacks"):
        calibrate_in_stages(
            record(Recorder(cells=(8, 7), frames=4)),
            CalibrationConfig(mesh=Mesh((8, 7))),
            "global+local",
            progress=lambda done, total, message: told.append(done),
        )
    assert not told


def test_of_a_woven_mesh_the_bending_of_the_weft_is_not_searched() -> None:
    scene = record(Recorder(cells=(8, 7), frames=4))
    for mesh, searched in ((None, True), (Mesh((8, 7)), False)):
        config = CalibrationConfig(law="orthotropic_sheet", mesh=mesh)
        names = {p.name for p in searched_parameters(scene, prior_twin(scene, config), config)}
        assert {"weft_ratio", "shear_ratio"} <= names and ("bending_weft_ratio" in names) is searched


def test_the_modulus_of_another_engines_mesh_is_found_to_a_percent() -> None:
    sheet = Recorder(cells=(8, 7), frames=14, noise_sigma_m=5e-4, seed=3)
    fitted = calibrate(
        record(sheet), CalibrationConfig(max_simulations=60, damping="none", mesh=Mesh((8, 7)))
    )
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(sheet.young_pa, rel=0.01)
    found = fit_accuracy(record(sheet), fitted, 2000)
    assert found["numerics"] is None and "cells of triangles has no finer" in found["not_measured"]
