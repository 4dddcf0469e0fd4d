"""The catalogue is what the registries say, its tables in the docs are current, and every part reads it."""

from __future__ import annotations

import re

import pytest

from physworld.catalogue import quantities
from physworld.effects.registry import EFFECTS
from physworld.evaluate.metrics import metrics
from physworld.materials.library import ELASTIC_LAWS
from physworld.materials.plastic import PLASTICITIES
from physworld_schemas.fit import FitConfig
from physworld_schemas.library import Catalogue, catalogue, known_names
from physworld_schemas.trace import TraceConfig
from scripts.catalogue import CATALOGUE, ROOT, TABLE, own_catalogue, tables, written

WRITE = "run python -m scripts.catalogue"


@pytest.fixture(scope="module")
def described() -> Catalogue:
    return own_catalogue()


def test_the_file_is_what_the_registries_say(described: Catalogue) -> None:
    assert Catalogue.model_validate_json(CATALOGUE.read_bytes()) == described, WRITE


def test_the_tables_of_the_pages_are_current(described: Catalogue) -> None:
    by_name = tables(described)
    pages = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("*.md"))}
    stale = [path.name for path, page in pages.items() if written(page, by_name) != page]
    assert stale == [], WRITE
    shown = [found["name"] for page in pages.values() for found in TABLE.finditer(page)]
    assert sorted(shown) == sorted(by_name)


def test_every_law_says_what_it_is_and_what_its_constants_mean() -> None:
    laws = [*ELASTIC_LAWS.values(), *PLASTICITIES.values()]
    assert len({law.title for law in laws}) == len({law.use for law in laws}) == len(laws)
    for law in laws:
        for name, quantity in quantities(law).items():
            assert quantity.help, name
            assert (quantity.unit == "1") == (re.search(r"(_pa|_m|_m2|_m3|_s|_n|_rad)$", name) is None), name


def test_requests_may_name_what_the_registries_have() -> None:
    assert known_names("law") == ["auto", *ELASTIC_LAWS]
    assert known_names("flow law") == list(PLASTICITIES)
    assert known_names("effect") == list(EFFECTS)
    fields = FitConfig.model_json_schema()["properties"]
    assert fields["law"]["anyOf"][0]["enum"] == known_names("law")
    assert fields["plasticity"]["anyOf"][0]["enum"] == known_names("flow law")
    assert TraceConfig.model_json_schema()["properties"]["candidates"]["items"]["enum"] == list(EFFECTS)


def test_a_metric_that_is_not_installed_keeps_its_name() -> None:
    assert [metric.name for metric in catalogue().metrics] == list(metrics())
    assert [metric.name for metric in catalogue().listed_metrics()] == [
        "track_m",
        "chamfer_phystwin_m",
        "chamfer_l2_m",
    ]
    assert catalogue().metric("track_m").unit == "m"
    unknown = catalogue().metric("grip_n")
    assert (unknown.title, unknown.unit) == ("grip_n", "1")


def test_no_file_of_the_system_keeps_a_list_of_its_own() -> None:
    """Laws, effects and metrics are named where they are implemented; one name may stand where its meaning matters."""
    names = {*ELASTIC_LAWS, *PLASTICITIES, *EFFECTS, *metrics()} - {
        "plasticity",
        "wind",
        "rod",
    }  # words of their own
    mirrors = {}
    for room in ("schemas", "scenes", "services", "storage", "workers", "clients"):
        for path in (ROOT / room).glob("**/*.py"):
            named = names & set(re.findall(r"[\"'](\w+)[\"']", path.read_text(encoding="utf-8")))
            if len(named) > 1:
                mirrors[str(path.relative_to(ROOT))] = named
    assert mirrors == {}
