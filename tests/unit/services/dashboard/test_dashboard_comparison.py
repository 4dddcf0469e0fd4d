"""The page that holds two versions of a model side by side."""

from __future__ import annotations

import html
import json
import re

import httpx
import pytest
from dashboard_served import Served
from sqlalchemy.orm import Session

from physworld_schemas.base import Lineage
from physworld_schemas.model import TrainingConfig
from physworld_services.stores import Stores
from physworld_storage import registry

CARD = {
    "intended_use": "Predict <this> object.",
    "limits": "Turns are extrapolated.",
    "trained_on": {"statistics": {"motions": {"lift": 7, "hold_one": 3}}},
}
STRENGTHS = {"air_drag_linear.rate_per_s": {"calibrated": 1.9, "ci95": [1.6, 2.2], "tuned": 2.05}}


@pytest.fixture
def client(dashboard: Served) -> httpx.Client:
    """A browser on a dashboard with two ready versions of ``beam``, one of ``lonely``, and ``lost``, which diverged."""
    with dashboard.database.session() as session:
        publish_all(session, dashboard.stores)
    return dashboard.client


def publish_all(session: Session, stores: Stores) -> None:
    """The versions that the browser looks at."""
    for name, error_m in (
        ("beam", 0.004),
        ("beam", 0.0031),
        ("beam", 0.0035),
        ("lonely", 0.001),
        ("lost", 0.752),
    ):
        curves = {name: [error_m, error_m, None] for name in ("twin", "world_model_finetuned", "static")}
        table = {
            "track_m": dict.fromkeys(curves, error_m) | {"static": 0.1},
            "ci95": {"track_m": {name: [0.9 * error_m, 1.1 * error_m] for name in curves}},
            "frames": [10, 13],
            "per_frame": {"times_s": [0.3, 0.4, 0.5], "track_m": curves},
        }
        row = registry.allot_version(session, name, config=TrainingConfig(seed=round(1e5 * error_m)))
        registry.publish(
            session,
            name,
            row.version,
            artifacts=[stores.artifacts.put_bytes(json.dumps(CARD).encode(), "card.json")],
            sha256="e" * 64,
            metrics={"held_out": table, "fine_tuning": {"strengths": STRENGTHS}},
            lineage=Lineage(),
        )
    registry.set_alias(session, "beam", "champion", 2)


def test_two_versions_are_held_side_by_side(client: httpx.Client) -> None:
    assert 'href="/dashboard/models/beam/compare"' in client.get("/dashboard/models/beam").text
    page = client.get("/dashboard/models/beam/compare?a=1&b=champion")
    assert page.status_code == 200
    for text in ("Version 1", "Version 2", "4.00", "3.10", "0.900", "Settings: seed", "400", "310"):
        assert text in page.text, text
    [told] = re.findall(r'data-series="([^"]*)"', page.text)
    lines = {line["label"]: line for line in json.loads(html.unescape(told))}
    assert lines["world model, fine-tuned, version 1"]["values"] == [4.0, 4.0, None]
    assert lines["world model, fine-tuned, version 2"]["values"] == [3.1, 3.1, None]
    assert {line["role"] for label, line in lines.items() if label.startswith("world")} == {"model"}
    assert len(lines) == 4


def test_any_number_of_versions_is_plotted_with_intervals(client: httpx.Client) -> None:
    page = client.get("/dashboard/models/beam/compare?a=1&b=2&also=3").text
    drawings = re.findall(r"<title>Mean track errors of the versions.*?</svg>", page, re.DOTALL)
    assert len(drawings) == 2  # for wide and for narrow windows
    for forest in drawings:
        for version in (1, 2, 3):
            assert f"world model, fine-tuned, version {version}<" in forest
        assert forest.count("<circle") == 6  # twin and world model of each
        assert forest.count('class="line model"') == 3  # an interval each
    assert 'name="also" value="3" checked' in page


def test_any_number_of_versions_is_tabled_with_intervals_and_gains_against_the_first(
    client: httpx.Client,
) -> None:
    page = client.get("/dashboard/models/beam/compare?a=1&b=2&also=3&also=1").text
    head = re.search(r"<th>Predictor</th>(.*?)</tr>", page)
    assert head is not None
    told = re.findall(r">([^<]+)</th>", head[1])
    assert told == ["Version 1", "Version 2", "Gain", "Version 3", "Gain"]
    row = re.search(r"<td>World model, fine-tuned</td>(.*?)</tr>", page)
    assert row is not None
    shown = [re.sub(r"<[^>]*>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row[1])]
    assert [cell.split(" ")[0] for cell in shown] == ["4.00", "3.10", "0.900", "3.50", "0.500"]
    assert all(" to " in cell for cell in shown)
    seeds = re.search(r"<td>Settings: seed</td>(.*?)</tr>", page)
    assert seeds is not None and re.findall(r">(\d+)<", seeds[1]) == ["400", "310", "350"]
    assert client.get("/dashboard/models/beam/compare?a=1&b=1").status_code == 200


def test_without_a_choice_the_two_newest_are_taken(client: httpx.Client) -> None:
    page = client.get("/dashboard/models/beam/compare").text
    assert '<option value="2" selected>' in page and '<option value="3" selected>' in page
    assert client.get("/dashboard/models/lonely/compare").status_code == 200
    assert client.get("/dashboard/models/beam/compare?a=1&b=nobody").status_code == 404


def test_a_version_that_failed_the_quality_gate_has_a_red_mark_everywhere(client: httpx.Client) -> None:
    red = '<span class="badge failed" title="it errs 752 mm'
    for path in ("", "/lost", "/lost/1"):
        page = client.get(f"/dashboard/models{path}").text
        assert red in page and page.count("badge failed") == 1
    assert (
        "does not become <code>latest</code>: it errs 752 mm" in client.get("/dashboard/models/lost/1").text
    )
    assert '<span class="badge tag">latest</span>' not in client.get("/dashboard/models/lost").text
    good = client.get("/dashboard/models/beam").text
    assert "badge failed" not in good and good.count('<span class="badge tag">latest</span>') == 1


def test_a_page_of_a_version_answers_to_its_alias(client: httpx.Client) -> None:
    assert "version 2" in client.get("/dashboard/models/beam/champion").text


def test_the_page_of_a_version_says_what_it_is_for_and_where_it_ends(client: httpx.Client) -> None:
    page = client.get("/dashboard/models/beam/2").text
    for text in (
        "Predict &lt;this&gt; object.",
        "Turns are extrapolated.",
        "7 lift, 3 hold one",
        "stands at 2.05",
    ):
        assert text in page, text
