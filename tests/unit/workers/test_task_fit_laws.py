"""Fits of the service under other laws: named ones, a chosen one, and a twin that flows demonstrates."""

from __future__ import annotations

import pytest
from pydantic import ValidationError
from test_tasks import _drain, _make_dataset

from physworld.calibrate import Journal
from physworld_schemas.fit import Fit, FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_storage import resources
from physworld_storage.jobs import jobs
from physworld_workers.law_choice import AUTO, chosen_laws
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

SMALL = {"particle_budget": 60, "max_simulations": 8, "damping": "none"}


def fitted(runtime, scene_id: str, **laws: str) -> Fit:
    with runtime.database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig.model_validate({**SMALL, **laws}))
    _drain(runtime)
    with runtime.database.reading() as session:
        return resources.get_fit(session, job.outputs[0].id)


def test_a_flowing_twin_is_fitted_and_demonstrates(runtime_with, stores: Stores, scene_id: str) -> None:
    fit = fitted(runtime_with(), scene_id, plasticity="von_mises")
    assert fit.state == "ready" and "yield_stress_pa" in fit.parameters
    assert fit.metrics["formulation"]["name"] == "updated_lagrangian"
    assert fit.numerics is not None and fit.numerics.half_step_m > 0.0
    assert fit.converged is None and "total Lagrangian" in fit.not_measured
    assert (fit.metrics["law"]["plastic"], fit.metrics["law"]["decided_by"]) == ("von_mises", "given")
    job, dataset = _make_dataset(runtime_with(), fit, episodes=2, frames=6)
    assert (job.state, dataset.state, dataset.statistics["episodes"]) == ("succeeded", "sealed", 2)


def test_a_law_is_chosen_by_cross_validation_and_recorded(
    runtime_with, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHYSWORLD_LAW_URL", raising=False)
    fit = fitted(runtime_with(), scene_id, law="auto")
    assert fit.metrics["law"]["decided_by"] == "cross_validation"
    assert set(fit.metrics["law"]["figures"]["held_out_rms_m"]) >= {"neo_hookean", "fixed_corotated"}


def test_a_choice_that_an_earlier_attempt_made_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    from tiny_scene import tiny_scene

    from physworld.calibrate import CalibrationConfig

    monkeypatch.setenv("PHYSWORLD_LAW_MODEL", "m")
    monkeypatch.setenv("PHYSWORLD_LAW_URL", "http://127.0.0.1:1")  # nobody answers there: it is not asked
    answer = "Elastic: St. Venant-Kirchhoff | Plastic: Von Mises | Reason: it dents"
    texts: list[str] = []
    Journal("k", None, texts.append).step("asked", lambda: {"text": answer, "unavailable": None})
    config, choice = chosen_laws(
        AUTO, tiny_scene(), CalibrationConfig(particle_budget=60), journal=Journal("k", texts[-1])
    )
    assert (config.law, config.plasticity) == ("st_venant_kirchhoff", "von_mises")
    assert choice.reason == "it dents"


@pytest.mark.parametrize(
    "fit", [{"law": "hencky"}, {"formulation": "updated_lagrangian"}, {"plasticity": "von_mises"}]
)
def test_a_trace_refuses_other_physics(fit: dict) -> None:
    with pytest.raises(ValidationError, match=r"fit\.law, fit\.plasticity"):
        TraceCreate.model_validate({"scene_id": "scn_x", "fit": fit})
    with pytest.raises(ValidationError, match=r"fit\.law, fit\.plasticity"):
        PipelineCreate.model_validate({"scene_id": "scn_x", "close_the_loop": True, "fit": fit})
    PipelineCreate.model_validate({"scene_id": "scn_x", "fit": fit})
