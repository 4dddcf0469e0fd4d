"""The picture of a lineage: boxes that are links, lines between them, and no more boxes than a page can hold."""

from __future__ import annotations

import re

from physworld_services.dashboard.lineage import MOST_SHOWN, address_of, drawn
from physworld_storage.family import Member

SCENE = Member("scn_1", "scene", 0, "beam <b>", "", ())
OLD = Member("fit_old", "fit", 1, "…old", "ready", ("scn_1",))
FITS = [Member(f"fit_{i}", "fit", 1, f"…{i}", "ready", ("scn_1",)) for i in range(9)]
VERSION = Member("soft beam:2", "model", 4, "soft beam 2", "failed", ("fit_old",))


def test_every_box_is_a_link_with_words_and_the_object_itself_is_marked() -> None:
    picture = drawn([SCENE, OLD, VERSION], "fit_old")
    links = re.findall(r'<a href="([^"]+)" aria-label="([^"]+)"( aria-current="true")?', picture)
    assert links == [
        ("/dashboard/scenes/scn_1", "scene beam &lt;b&gt;", ""),
        ("/dashboard/fits/fit_old", "fit …old, ready", ' aria-current="true"'),
        ("/dashboard/models/soft%20beam/2", "model soft beam 2, failed", ""),
    ]
    assert picture.count("<path") == 2
    assert "<b>" not in picture
    assert address_of(VERSION) == "/dashboard/models/soft%20beam/2"


def test_what_is_ready_and_wrong_has_the_colour_of_what_is_wrong() -> None:
    unfinished = Member("fit_u", "fit", 1, "…u", "not converged", ("scn_1",))
    refused = Member("soft beam:3", "model", 4, "soft beam 3", "failed the gate", ("fit_u",))
    picture = drawn([SCENE, unfinished, refused], "fit_u")
    assert 'class="state cancelling">not converged<' in picture
    assert 'class="state failed">failed the gate<' in picture


def test_text_is_cut_off_at_the_side_of_its_box() -> None:
    wide = Member("fit_w", "fit", 1, "W" * 60, "ready", ("scn_1",))
    picture = drawn([SCENE, wide], "fit_w")
    [(outer, left, inner, texts)] = re.findall(
        r'<rect x="196" y="26" width="(\d+)".*?<svg x="(\d+)" y="26" width="(\d+)" height="42">(.*?)</svg>',
        picture,
    )
    assert int(left) > 196 and int(left) + int(inner) < 196 + int(outer)
    assert texts.count("<text") == 2 and "WW…" in texts


def test_columns_that_nothing_is_in_take_no_place() -> None:
    assert re.findall(r'class="column">([^<]+)<', drawn([SCENE, OLD, VERSION], "scn_1")) == [
        "Scene",
        "Fits",
        "Model versions",
    ]


def test_a_long_column_shows_the_newest_says_how_many_more_and_keeps_the_way_to_the_object() -> None:
    picture = drawn([SCENE, *FITS, OLD, VERSION], "soft beam:2")
    shown = re.findall(r'href="/dashboard/fits/(\w+)"', picture)
    assert len(shown) == MOST_SHOWN
    assert shown[-1] == "fit_old"
    assert f"and {10 - MOST_SHOWN} more" in picture
    assert 'href="/dashboard/fits?q=beam+%3Cb%3E"' in picture
