"""The figures of the concepts: they are what their script draws, well-formed, and told in words where they stand."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from scripts.make_concept_figures import CARD, IMAGES, MEASURED, figures

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs"
DRAWN = figures(json.loads(MEASURED.read_text()))


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_is_what_the_script_draws_and_its_page_tells_it_in_words(name: str) -> None:
    path = IMAGES / f"concept_{name}.svg"
    assert path.read_text() == DRAWN[name], "run `python -m scripts.make_concept_figures`"
    assert path.stat().st_size < 40_000
    (alt,) = re.findall(rf"!\[([^\]]*)\]\(images/{path.name}\)", (DOCS / f"{name}.md").read_text())
    assert len(alt.split()) > 15


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_stands_on_its_own_card_and_inside_it(name: str) -> None:
    root = ElementTree.fromstring(DRAWN[name])
    width, height = (float(root.attrib[side]) for side in ("width", "height"))
    card = next(part for part in root if part.tag.endswith("rect"))
    assert card.attrib["fill"] == CARD and float(card.attrib["width"]) == width - 1
    for part in root.iter():
        for key, end in (
            ("x", width),
            ("x1", width),
            ("x2", width),
            ("cx", width),
            ("y", height),
            ("cy", height),
        ):
            assert 0 <= float(part.attrib.get(key, 1)) <= end, part.attrib


def test_the_measured_curves_show_what_the_pages_say() -> None:
    measured = json.loads(MEASURED.read_text())
    scan, found = measured["calibration"], measured["calibration"]["found"]
    assert min(scan["scan"]["training_rms_mm"]) > 5 > 1.2 * scan["noise_mm"] > found["training_rms_mm"]
    trace = measured["trace"]
    held = slice(trace["training_frames"], None)
    assert max(trace["after_mm"][held]) < 2 * trace["noise_mm"] < 0.2 * max(trace["before_mm"][held])
    low, high = trace["parameters"]["rate_per_s"]["ci95"]
    assert trace["effect"] == "air_drag_linear" and low < 4 < high
