"""A fit of a sheet as the mesh that recorded it: asked for in a request, calibrated, and not asked for finer cells."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pydantic import ValidationError

from benchmarks.peers.flex_cloths import Mesh as Recorder
from benchmarks.peers.flex_sheet import record
from physworld.calibrate import CalibrationConfig, Journal, calibrate, calibrate_in_stages
from physworld.calibrate.global_stage import prior_twin, searched_parameters
from physworld.engine.thin.triangles import Mesh, mesh_of
from physworld.errors import SceneUnsupported
from physworld_schemas.fit import FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_workers.mesh_choice import fitted_as_recorded
from physworld_workers.tasks.fit_accuracy import fit_accuracy


def test_a_request_names_a_mesh_or_is_refused() -> None:
    assert FitConfig(mesh="16x15").mesh == "16x15" and not FitConfig(mesh="8x9odd").usual_physics
    for wrong in ("16", "0x4", "16x15 ", "16 x 15", "1000x4"):
        with pytest.raises(ValidationError, match="mesh"):
            FitConfig(mesh=wrong)
    with pytest.raises(ValidationError, match="gradients, which mesh 4x4 lacks"):
        FitConfig(mesh="4x4", stages="global+local")
    assert FitConfig(mesh="250x200odd").mesh == "250x200odd"
    with pytest.raises(ValidationError, match="mesh 999x999 has 3992004 particles; 200000 are the most"):
        FitConfig(mesh="999x999")
    with pytest.raises(ValidationError, match=r"fit\.mesh"):
        PipelineCreate(scene_id="scn", fit=FitConfig(mesh="4x4"), close_the_loop=True)


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
    assert found["numerics"] is None and "the recorder's own" in found["not_measured"]


def test_which_mesh_recorded_a_sheet_is_found_and_kept_for_a_later_attempt() -> None:
    sheet = Recorder(cells=(8, 7), frames=14, noise_sigma_m=5e-4, seed=3)
    config, texts = CalibrationConfig(particle_budget=300, max_simulations=60, damping="none"), []
    fitted = fitted_as_recorded(
        "auto", record(sheet), config, "global", journal=Journal("k", None, texts.append)
    )
    assert mesh_of(fitted.twin.lattice) == Mesh((8, 7))
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(sheet.young_pa, rel=0.01)
    again = fitted_as_recorded("auto", record(sheet), config, "global", journal=Journal("k", texts[-1]))
    assert again.parameters["youngs_modulus_pa"].value == fitted.parameters["youngs_modulus_pa"].value
    assert FitConfig(mesh="auto").mesh == "auto" and not FitConfig(mesh="auto").usual_physics
    woven = replace(config, law="orthotropic_sheet", max_simulations=12)
    assert mesh_of(fitted_as_recorded("auto", record(sheet), woven, "global").twin.lattice) is None
    with pytest.raises(ValueError, match="need gradients"):
        fitted_as_recorded("auto", record(sheet), config, "global+local")


def test_a_mesh_that_was_weighed_against_a_fit_without_its_budget_is_not_a_converged_choice() -> None:
    """100 simulations are enough for the mesh's search, not for the plate's: its interval holds, the choice may not."""
    sheet = Recorder(cells=(8, 7), frames=14, noise_sigma_m=5e-4, seed=3)
    config = CalibrationConfig(particle_budget=300, max_simulations=100, damping="none")
    fitted = fitted_as_recorded("auto", record(sheet), config, "global")
    assert mesh_of(fitted.twin.lattice) == Mesh((8, 7)) and not fitted.cut_short
    assert fitted.parameters["youngs_modulus_pa"].ci95 is not None
    assert set(fitted.open) == {"mesh"} and "budget of 100 simulations" in fitted.open["mesh"]
