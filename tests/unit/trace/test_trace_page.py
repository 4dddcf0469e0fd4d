"""The page of a trace: honest sentences, pictures of what is given, everything escaped, nothing loaded."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_scene import made_scene
from PIL import Image

from physworld.report import render
from physworld.report.curves import per_frame, residuals
from physworld.report.maps import png
from physworld.report.markup import Html, tag
from physworld.report.svg import decades, round_ticks
from physworld.report.words import VERDICTS, headline, interval, label, number, quantity
from physworld.scene import Scene

pytestmark = pytest.mark.slow

FRAMES, SPLIT = 20, 14
NAMES = {
    "rate_per_s",
    "youngs_modulus_pa",
    "ground_friction",
    "finer cells",
    "air_drag_linear",
}  # keys that are shown
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


def recording() -> tuple[Scene, np.ndarray, np.ndarray]:
    """Five points that swing, some unseen, at uneven times; a prediction that drifts away and one that does not."""
    times = np.cumsum(0.03 + 0.01 * np.sin(np.arange(FRAMES))) - 0.03
    scene = made_scene([[0.1 * k, 0.0, 0.5] for k in range(5)], "rope", frames=FRAMES)
    path = np.stack([0 * times, 0.02 * np.sin(6 * times), 0 * times], axis=1)
    visible = scene.visible.copy()
    visible[5:8, 2], visible[9] = False, False
    points = np.where(visible[..., None], scene.points + path[:, None], np.nan)
    scene = replace(
        scene, times=times, points=points, visible=visible, train=(0, SPLIT), test=(SPLIT, FRAMES)
    )
    truth = scene.points[:1] + path[:, None]
    drift = 0.01 * times[:, None, None] * np.array([0.0, 1.0, 0.0])
    return scene, truth + drift, truth + 0.1 * drift


def test_of_several_recordings_each_has_its_errors() -> None:
    scene, before, after = recording()
    known = {"frames": [1, 20], "before": 0.004, "after": 0.002, "noise_floor": 0.001}
    every = [{"scene": "first", "role": "fitted", **known}, {"scene": HOSTILE, "role": "held_out", **known}]
    page = render(report(recordings=every), scene, before, after)
    assert "Recordings" in page and "only measured" in page and "1 to 19" in page and HOSTILE not in page
    assert "only measured" not in render(report(recordings=every[:1]), scene, before, after)


def report(**given: Any) -> dict[str, Any]:
    """A report with everything in it."""
    rate = {"value": 1.48, "unit": "1/s", "ci95": [1.3, 1.6]}
    found = {
        "scene": "made rope",
        "verdict": "named",
        "reason": "misfit 5.10 to 1.08 of the noise",
        "effects": [
            {"name": "air_drag_linear", "title": "linear air drag", "parameters": {"rate_per_s": rate}}
        ],
        "equivalent": [],
        "candidates": [
            {"name": "air_drag_linear", "variant": None, "score": 0.8, "threshold": 0.3,
             "selected": True},
            {"name": "tether", "variant": "towards +0 +1 +0", "score": 0.0, "threshold": 0.3,
             "selected": False},
        ],
        "refused": {"ground_friction": "no ground"},
        "path": [{"base": [], "threshold": 0.3, "scores": [{"name": "air_drag_linear", "score": 0.8}],
                  "tried": [{"effects": ["air_drag_linear"], "variants": [""], "misfit": 1.08, "left_out_error": 1.17,
                             "values": {"youngs_modulus_pa": 4e4, "air_drag_linear.rate_per_s": 1.48}}],
                  "kept": ["air_drag_linear"]}],
        "training": {"misfit_before": 5.1, "misfit_after": 1.08, "numerics": {"finer cells": 0.1}},
        "hypotheses": [{"effects": ["air_drag_linear"], "posterior": 0.973, "misfit": 1.08, "left_out": 1.17,
                        "discrepancy_m": 0.0},
                       {"effects": [], "posterior": 0.027, "misfit": 5.1, "left_out": 5.3, "discrepancy_m": 0.002}],
        "held_out": {"noise_floor": 0.001, "before": 0.0096, "after": 0.0012, "after_ci95": [0.0011, 0.0013],
                     "explained_fraction": 0.98},
        "calibrated": {"youngs_modulus_pa": {"value": 4e4, "unit": "Pa", "ci95": [3.9e4, 4.1e4]}},
        "unexplained": {"rms_m": 0.0004, "description": "it grows over time"},
        "suggested_experiment": {
            "description": "Shake the grip.", "times_s": [0.0, 0.1, 0.2], "frame_times_s": [0.0, 0.2],
            "controllers": [[[0.0, 0, 0]], [[0.01, 0, 0]], [[0.0, 0, 0]]], "difference_m": [0.0, 0.004],
        },
        "notes": ["one note"],
        "seconds": 12.0,
        "simulations": 90,
    }  # fmt: skip
    return {**found, **given}


class Reader(HTMLParser):
    """Elements, attributes and text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((name, dict(attributes)))

    def handle_data(self, data: str) -> None:
        self.text += data * (self.elements[-1][0] not in ("script", "style") if self.elements else 1)


def spoiled(value: Any) -> Any:
    """Every text of a report, and every key that is shown, made hostile."""
    if isinstance(value, dict):
        return {key + HOSTILE * (key in NAMES): spoiled(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [spoiled(v) for v in value]
    return value + HOSTILE if isinstance(value, str) else value


def test_a_page_says_shows_and_offers_what_the_report_holds() -> None:
    scene, before, after = recording()
    page = Reader(render(report(), scene, before, after))
    for text in ("Best supported among 2 candidates: linear air drag, rate 1.48 1/s (95 %: 1.30 to 1.60 1/s).",
                 "9.60 mm → 1.20 mm", "98%", "5.10 → 1.08", "40.0 kPa", "39.0 to 41.0 kPa", "0.97", "0.027", "2.00 mm",
                 "it grows over time".capitalize(), "Shake the grip.", "One note.", "no ground", "1 more explain less",
                 "threshold 0.300", "90 simulations"):  # fmt: skip
        assert text in page.text, text
    assert sum(name == "canvas" for name, _ in page.elements) == 2
    assert sum(name == "svg" and a.get("role") == "img" for name, a in page.elements) == 1 + 3 + 2 + 2 + 2
    link = next(a["href"] for name, a in page.elements if name == "a")
    points = json.loads(base64.b64decode(link.split(",", 1)[1]))
    assert points["controllers"][1] == [[0.01, 0, 0]]


def test_nothing_that_a_report_or_a_scene_says_becomes_markup_and_nothing_is_loaded() -> None:
    scene, before, after = recording()
    given = spoiled(report())
    page = render({**given, "verdict": "equivalent_set", "equivalent": given["effects"]},
                  replace(scene, name=HOSTILE), before, after)  # fmt: skip
    clean = Reader(
        render(report(verdict="equivalent_set", equivalent=report()["effects"]), scene, before, after)
    )
    found = Reader(page)
    assert [name for name, _ in found.elements].count("script") == 2
    assert not any(name in ("img", "iframe", "link", "object") for name, _ in found.elements)
    assert not any(key.startswith("on") for _, attributes in found.elements for key in attributes)
    assert "alert(1)" in found.text and "alert(1)" not in clean.text
    assert (
        not re.search(r"(?:src|href)=[\"'](?!data:)", page) and "url(" not in page and "@import" not in page
    )
    policy = next(a["content"] for name, a in found.elements if name == "meta" and "http-equiv" in a)
    assert policy is not None and policy.startswith("default-src 'none'")


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_its_sentence_and_claims_no_more(verdict: str) -> None:
    other = [{"name": "measurement_clock", "parameters": {}}]
    said = headline(report(verdict=verdict, equivalent=other if verdict == "equivalent_set" else []))
    assert "2 candidates" in said or verdict == "numerical_issue"
    assert ("linear air drag" in said) == (verdict in ("named", "equivalent_set", "data_issue"))
    assert ("cannot tell" in said) == (verdict == "equivalent_set")
    scene, before, _ = recording()
    page = Reader(render(report(verdict=verdict), scene, before, before))
    assert VERDICTS[verdict][0] in page.text and sum(n == "canvas" for n, _ in page.elements) == 1
    claimed = ("named", "equivalent_set", "data_issue")
    assert ("What was found" in page.text) == (verdict in claimed)
    assert ("is not claimed" in page.text) == (verdict == "numerical_issue")


def test_a_report_with_little_in_it_and_no_motion_still_gives_a_page() -> None:
    scene, before, after = recording()
    still = replace(scene, controllers=np.zeros((FRAMES, 0, 3)), test=(FRAMES, FRAMES))
    nothing = {
        "description": "Nothing holds this body.",
        "controllers": [],
        "times_s": [],
        "difference_m": [],
    }
    for given in ({"scene": "x", "verdict": "unexplained"}, report(suggested_experiment=nothing)):
        page = Reader(render(given, still, before, after))
        for name, attributes in page.elements:
            if name in ("path", "line", "rect", "circle"):
                assert not any("nan" in str(value) for value in attributes.values()), (name, attributes)
    with pytest.raises(ValueError, match=r"\(5, 5, 3\)"):
        render(report(), scene, before[:5], after)


def test_residuals_leave_out_what_was_not_seen() -> None:
    scene, before, after = recording()
    found = residuals(scene, before, after, SPLIT)
    shown = per_frame(found.before)
    expected = 0.01 * scene.times / np.sqrt(3.0)
    assert np.isnan(shown[9]) and np.allclose(np.delete(shown, 9), np.delete(expected, 9))
    assert list(found.order) in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0])
    assert found.split_s == scene.times[SPLIT] and not found.same


def test_the_view_holds_the_points_to_a_step_and_misses_the_unseen() -> None:
    scene, before, after = recording()
    page = render(report(), scene, before, after)
    data = json.loads(re.search(r"data-points>(.*?)</script>", page).group(1))
    steps = np.frombuffer(base64.b64decode(data["clouds"]["measured"]), "<i2").reshape(FRAMES, 5, 3)
    places = np.array(data["low"]) + steps / 32767 * data["size"]
    assert np.array_equal((steps == -32768).all(axis=2), ~scene.visible)
    assert np.allclose(places[scene.visible], scene.points[scene.visible], atol=data["size"] / 32767)
    assert data["rms"]["before"]["test"][0] > data["rms"]["after"]["test"][0] > 0


def test_markup_escapes_all_but_markup() -> None:
    assert tag("p", "<b>", Html("<i></i>"), [1, None], title='"<', hidden=True, lang=None) == (
        '<p title="&quot;&lt;" hidden>&lt;b&gt;<i></i>1</p>'
    )
    assert tag("line", x1=1.0) == '<line x1="1"/>'


def test_numbers_are_short_and_carry_units_that_suit_them() -> None:
    assert [number(v) for v in (0.0, 1.4801, 123.0, 4e-7, -2.5e6, None)] == [
        "0", "1.48", "123", "4.00×10⁻⁷", "-2.50×10⁶", "–",
    ]  # fmt: skip
    assert quantity(4e4, "Pa") == "40.0 kPa" and quantity(0.033, "s") == "33.0 ms"
    assert quantity(0.1, "rad") == "0.100 rad (5.73°)" and quantity(2.0, "1") == "2.00"
    assert (
        interval({"ci95": [0.001, 0.002], "unit": "m"}) == "1.00 to 2.00 mm"
        and interval({"ci95": None}) == ""
    )
    assert [label(n) for n in ("rate_per_s", "bending_n_m2", "push_x_m_s2", "ratio", "reach_m")] == [
        "rate", "bending", "push x", "ratio", "reach",
    ]  # fmt: skip
    assert round_ticks(0.0, 1.0) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert decades(0.5, 20.0) == pytest.approx([0.5, 1, 2, 5, 10, 20])


def test_a_picture_survives_its_encoding() -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    content = png(rgba)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(content))), rgba)


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_shows_the_page_and_its_view_without_an_error(tmp_path: Path, scheme: Any) -> None:
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next((path for name in names if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    scene, before, after = recording()
    (tmp_path / "page.html").write_text(render(report(), scene, before, after))
    said: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 420, "height": 800}, color_scheme=scheme)
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto((tmp_path / "page.html").as_uri())
        page.wait_for_selector(".view[data-ready]")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420
        assert "held out" in page.inner_text("[data-clock]")
        page.fill("[data-slider]", "0")
        assert page.inner_text("[data-clock]").startswith("0.00 s")
        painted = "[...document.querySelectorAll('canvas')].every(c => c.getContext('2d')" + (
            ".getImageData(0, 0, c.width, c.height).data.some(v => v))"
        )
        assert page.evaluate(painted)
        chart = page.locator("section[data-linked] svg[data-time]").first
        chart.click()
        assert not page.inner_text("[data-clock]").startswith("0.00 s")
        browser.close()
    assert said == []
