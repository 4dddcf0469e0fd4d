"""What people stumbled over on the pages and in answers of the service; ``scripts/stumbles.py`` has the list."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import TEXTS, Request
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import Fit
from physworld_schemas.hints import hint_of
from physworld_schemas.key import KeyRotate
from physworld_schemas.live import LiveTicketCreate
from physworld_schemas.plan import PlanLimits, PointGoal
from physworld_services.api.errors import problem_response
from physworld_services.dashboard import text
from physworld_services.dashboard.site import environment_of_pages
from physworld_services.embedded.folder import DataFolder

AT = datetime(2026, 1, 2, tzinfo=UTC)


def shown(search: dict[str, object] | None) -> str:
    fields = {
        "id": "fit_1",
        "scene_id": "scn_1",
        "state": "ready",
        "created_at": AT,
        "job_id": "job_1",
        "config": {},
    }
    macros = environment_of_pages().get_template("macros.html").make_module({"may_write": True})
    fit = Fit.model_validate({**fields, "search": search})
    return str(macros.badge(fit.standing))  # type: ignore[attr-defined]


def test_a_search_that_spent_its_budget_is_not_called_ready() -> None:
    assert 'class="badge cancelling">not converged<' in shown({"converged": False})
    assert ">ready<" in shown({"converged": True})
    assert ">ready<" in shown(None)


def test_lists_of_settings_are_words_and_no_code() -> None:
    assert text.figure(["torch_export", "onnx"]) == "torch_export, onnx"
    assert text.figure([0.25, 3]) == "0.25, 3"
    assert text.figure([]) == "–"


def test_an_error_of_rounding_is_no_row_of_zeros() -> None:
    assert text.millimetres(1.7e-19) == "0"
    assert text.millimetres(1.7e-7) == "0.000170"


def test_a_problem_has_a_hint_that_helps_or_none_at_all() -> None:
    told = json.loads(problem_response(404, "not_found", "no fit x", request_id=None).body)
    assert told["hint"] == hint_of("not_found")
    assert "hint" not in json.loads(problem_response(400, "unheard_of", "why", request_id=None).body)


@pytest.mark.parametrize(
    ("kept", "port"), [("8123\n", 8123), ("", 0), ("no number", 0), ("70000", 0), (None, 0)]
)
def test_the_port_of_the_last_run_is_remembered(tmp_path: Path, kept: str | None, port: int) -> None:
    folder = DataFolder(tmp_path)
    folder.port.parent.mkdir(parents=True)
    if kept is not None:
        folder.port.write_text(kept)
    assert folder.last_port() == port


def test_true_is_no_number_of_minutes() -> None:
    with pytest.raises(ValueError, match="grace_minutes\n  true and false are no numbers"):
        KeyRotate.model_validate({"grace_minutes": True})
    assert KeyRotate.model_validate({"grace_minutes": 3}).grace_minutes == 3


@pytest.mark.parametrize(
    ("model", "body", "place"),
    [
        (PlanLimits, {"workspace_max_m": [0.1, False, 0.1]}, "workspace_max_m"),
        (PointGoal, {"kind": "points", "index": [0], "places": [[0.0, 0.0, True]]}, "places"),
        (PointGoal, {"kind": "points", "index": [True], "places": [[0.0, 0.0, 0.0]]}, "index"),
        (DatasetConfig, {"patterns": {"lift": True}}, "patterns"),
        (LiveTicketCreate, {"model": "beam", "version": True}, "version"),
    ],
)
def test_true_and_false_are_no_numbers_in_lists_either(
    model: type[Request], body: dict[str, Any], place: str
) -> None:
    with pytest.raises(ValueError, match=f"{place}\n  true and false are no numbers"):
        model.model_validate(body)


def test_numbers_and_texts_are_not_read_as_true_and_false_nor_texts_as_numbers() -> None:
    with pytest.raises(ValueError, match="open_trace\n  0 is neither true nor false"):
        AssessmentCreate.model_validate({"scene_id": "scn_1", "open_trace": 0})
    with pytest.raises(ValueError, match="open_trace\n  a text where true or false is asked for"):
        AssessmentCreate.model_validate({"scene_id": "scn_1", "open_trace": "false"})
    with pytest.raises(ValueError, match="grace_minutes\n  a text where a number is asked for"):
        KeyRotate.model_validate({"grace_minutes": "3"})
    assert KeyRotate.model_validate({"grace_minutes": "3"}, context=TEXTS).grace_minutes == 3
    assert LiveTicketCreate.model_validate({"model": "beam", "version": "3"}).version == "3"
