"""Errors as people read them: no class of an exception, and the key that was probably meant."""

import json

import pytest
from pydantic import BaseModel, ValidationError

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.wording import pictures_among, reason


class Odd(Exception):
    """Has no text of its own."""


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("dt 2 s is longer than 1 s"), "dt 2 s is longer than 1 s"),
        (KeyError("controllers"), "there is no 'controllers'"),
        (FileNotFoundError(2, "No such file or directory", "a.json"), "a.json: No such file or directory"),
        (TimeoutError(), "timeout"),
        (Odd(), "odd"),
        (ValueError("two\n  lines"), "two lines"),
    ],
)
def test_the_reason_of_an_exception_never_names_its_class(error, said):
    assert reason(error) == said
    assert type(error).__name__ not in reason(error)


def faults(model: type[BaseModel], body: object) -> list[tuple[str, str, str]]:
    with pytest.raises(ValidationError) as caught:
        model.model_validate_json(json.dumps(body))
    return [(".".join(map(str, one["loc"])), one["msg"], one["type"]) for one in caught.value.errors()]


def test_an_unknown_key_is_told_with_the_nearest_one():
    [(place, said, kind)] = faults(DatasetConfig, {"epsiodes": 3})
    assert (place, kind) == ("epsiodes", "extra_forbidden")
    assert said == "unknown key; did you mean 'episodes'?"


def test_an_unknown_key_unlike_any_other_is_told_with_all_that_there_are():
    [(_, said, _)] = faults(DatasetConfig, {"zzz": 3})
    assert said.startswith("unknown key; known are ") and "'episodes'" in said and "'seed'" in said


def test_a_nested_key_keeps_its_place_beside_the_other_faults():
    body = {"scene_id": "scn_1", "training": {"stpes": 10, "hidden": "wide"}, "modelname": "beam"}
    found = {place: said for place, said, _ in faults(PipelineCreate, body)}
    assert found["training.stpes"] == "unknown key; did you mean 'steps'?"
    assert found["modelname"] == "unknown key; did you mean 'model_name'?"
    assert "integer" in found["training.hidden"]


def test_pictures_where_a_scene_is_expected_are_counted_and_the_importer_is_named():
    names = ["color/0.png", "color/1.PNG", "depth/0.npy", "notes.txt"]
    said = pictures_among(names, "recordings/rope")
    assert said.startswith("2 pictures were seen (0.png, ...)")
    assert "`physworld import recordings/rope --out SCENE`" in said
    assert pictures_among(["scene.json"], "here") == ""
