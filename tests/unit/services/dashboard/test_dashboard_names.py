"""Names of fields, units and counts as people read them."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterator

import pytest
from pydantic import BaseModel, Field

import physworld_schemas
from physworld.report import names
from physworld_schemas.job import Event
from physworld_schemas.library import catalogue
from physworld_schemas.model import VersionPatch
from physworld_services.dashboard.forms import form_of
from physworld_services.dashboard.pages_jobs import describe
from physworld_services.dashboard.site import environment_of_pages
from physworld_services.dashboard.starts import STARTS
from physworld_services.dashboard.text import amount, plain, progress_told
from physworld_storage.tables import utc_now


def declared() -> Iterator[tuple[str, str]]:
    """Every field of the wire models and every number of the catalogue that says its unit: (name, unit)."""
    for module in pkgutil.iter_modules(physworld_schemas.__path__):
        for model in vars(importlib.import_module(f"physworld_schemas.{module.name}")).values():
            if isinstance(model, type) and issubclass(model, BaseModel):
                for name, field in model.model_fields.items():
                    extra = field.json_schema_extra
                    if isinstance(extra, dict) and "unit" in extra:
                        yield name, str(extra["unit"])
    for named in (*catalogue().materials, *catalogue().effects):
        for name, quantity in named.parameters.items():
            yield name, quantity.unit


def test_the_unit_in_a_name_is_the_one_that_its_schema_declares() -> None:
    told = [(name, unit) for name, unit in declared() if names.unit(name)]
    assert len(told) > 100
    assert [(name, unit) for name, unit in told if names.unit(name) != names.written(unit)] == []


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("youngs_modulus_pa", "Young's modulus [Pa]"),
        ("poissons_ratio", "Poisson's ratio"),
        ("density_kg_m3", "Density [kg/m³]"),
        ("bending_n_m2", "Bending"),
        ("drag_normal_per_m", "Drag normal [1/m]"),
        ("noise_floor_m", "Noise floor [m]"),
        ("held_out_scene_ids", "Held out scenes"),
        ("config.steps", "Settings: steps"),
        ("validation.open_loop_m", "Validation: open loop [m]"),
        ("m", "M"),
    ],
)
def test_the_title_of_a_field(name: str, title: str) -> None:
    assert names.title(name) == title


def test_a_form_has_no_markup_of_the_schemas_and_no_bound_of_the_machine() -> None:
    class Body(BaseModel):
        version: int | str = Field(default="latest", description="Number, alias or `latest`.")
        count: int = Field(default=1, ge=1, le=2**31 - 1, description="How many.")

    version, count = form_of(Body, {}, {}).inputs
    assert (version.kind, version.value) == ("text", "latest")
    assert count.bounds == "from 1"
    about = environment_of_pages().get_template("_form.html").module.about
    assert "<code>latest</code>" in about(version) and "`" not in about(version)


def test_no_form_of_the_dashboard_shows_a_backtick_or_a_power_of_ten() -> None:
    environment = environment_of_pages()
    module = environment.get_template("_form.html").module
    for kind, start in STARTS.items():
        form = form_of(start.body, {}, {})
        shown = "".join(module.field(item) for item in form.inputs)
        shown += "".join(module.group(part) for part in form.groups)
        assert "`" not in shown, kind
        assert "e9" not in shown, kind


def test_counts_have_their_number() -> None:
    assert [amount(1, "runs"), amount(12, "runs"), amount(86.93, "percent")] == ["1 run", "12 runs", "87 %"]
    assert progress_told(20, 80, "simulations") == "20 of 80 simulations"
    assert progress_told(86.93, 100, "percent") == "87 %"
    assert progress_told(0, None, "steps") == ""


def test_an_event_says_percent_once() -> None:
    told = {"done": 86.93, "total": 100.0, "unit": "percent", "message": "refitting"}
    event = Event(seq=1, job_id="job_1", type="progress", at=utc_now(), data=told)
    assert describe(event) == "87 % · refitting"
    assert describe(event.model_copy(update={"data": {**told, "total": None}})) == "refitting"


def test_a_length_among_settings_has_its_unit_and_nothing_is_a_dash() -> None:
    assert plain({"region_max_m": [0.03, 0.5], "steps": 3}) == "region max (0.03, 0.5) m, steps 3"
    assert [plain(empty) for empty in ("", [], None)] == ["–", "–", "–"]


def test_a_sentence_calls_fields_as_people_do() -> None:
    fields = ["air_drag", "air_drag_linear", "actuation_lag"]
    told = names.reworded("this shows air_drag_linear and tells actuation_lag from air_drag", fields)
    assert told == "this shows air drag linear and tells actuation lag from air drag"


def test_a_request_says_that_texts_hold_no_nul() -> None:
    schema = VersionPatch.model_json_schema()
    tags = next(part for part in schema["properties"]["tags"]["anyOf"] if part.get("type") == "array")
    assert re.fullmatch(tags["items"]["pattern"], "a tag\nof two lines")
    assert not re.fullmatch(tags["items"]["pattern"], "half\x00")
