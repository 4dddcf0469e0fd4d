"""A fit of a sheet as the mesh that recorded it: asked for in a request, calibrated, and not asked for finer cells."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from benchmarks.flex_cloths import Mesh as Recorder
from benchmarks.flex_sheet import record
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.mpm.triangles import Mesh
from schemas.fit import FitConfig
from workers.tasks.fit_accuracy import fit_accuracy


def test_a_request_names_a_mesh_or_is_refused() -> None:
    assert FitConfig(mesh="16x15").mesh == "16x15" and not FitConfig(mesh="8x9odd").usual_physics
    for wrong in ("16", "0x4", "16x15 ", "16 x 15", "1000x4"):
        with pytest.raises(ValidationError, match="mesh"):
            FitConfig(mesh=wrong)
    with pytest.raises(ValidationError, match="gradients, which mesh 4x4 lacks"):
        FitConfig(mesh="4x4", stages="global+local")


def test_the_modulus_of_another_engines_mesh_is_found_to_a_percent() -> None:
    sheet = Recorder(cells=(8, 7), frames=14, noise_sigma_m=5e-4, seed=3)
    fitted = calibrate(
        record(sheet), CalibrationConfig(max_simulations=60, damping="none", mesh=Mesh((8, 7)))
    )
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(sheet.young_pa, rel=0.01)
    found = fit_accuracy(record(sheet), fitted, 2000)
    assert found["numerics"] is None and "the recorder's own" in found["not_measured"]
