"""What a browser sends for a form becomes the body that it stands for."""

from __future__ import annotations

import pytest

from physworld_schemas.base import TEXTS
from physworld_schemas.model import TrainingCreate
from physworld_services.dashboard.forms import Group, form_of, values_of

SENT = {"name": ["bar"], "dataset_id": ["dst_1"]}


@pytest.mark.parametrize(("typed", "expected"), [("", None), ("0", [0]), ("2, 0", [0, 2])])
def test_numbers_of_grips_are_typed_and_none_means_all(typed: str, expected: list[int] | None) -> None:
    values = values_of(TrainingCreate, SENT | {"config.holding": [typed], "config.formats": []})
    body = TrainingCreate.model_validate(values, context=TEXTS)
    assert body.config.holding == expected and body.config.formats == []


def test_numbers_of_grips_stand_in_the_form_that_asked_for_them() -> None:
    form: Group = form_of(TrainingCreate, {"config": {"holding": [0, 2]}}, {})
    (given,) = (item for item in form.groups[0].inputs if item.name == "config.holding")
    assert (given.kind, given.value) == ("words", "0, 2")
