"""``physworld effects list``: what it prints, for people and for programs, and that the page says the same."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from physworld.effects.registry import EFFECTS
from physworld_workers.commands.effects import main

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "effects.md").read_text()


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 0
    return capsys.readouterr().out


def test_json_has_every_effect_with_its_strengths_on_every_body(capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(printed(capsys, "--json"))
    entries = {entry["name"]: entry for entry in document["effects"]}
    assert list(entries) == list(EFFECTS)
    drag = entries["air_drag_linear"]["bodies"]
    assert set(drag) == {"solid", "sheet", "rod"}
    strength = drag["rod"]["strengths"][0]
    assert strength["name"] == "rate_per_s" and strength["unit"] == "1/s" and strength["gate"] is True
    assert strength["low"] == 0.0 < strength["probe"] < strength["high"]
    assert "one material direction" in entries["anisotropy"]["bodies"]["rod"]["refused"]
    assert entries["anisotropy"]["bodies"]["rod"]["strengths"] == []


def test_the_table_names_every_effect_with_kind_unit_and_refusal(capsys: pytest.CaptureFixture[str]) -> None:
    table = printed(capsys)
    for name, kind in EFFECTS.items():
        assert re.search(rf"^{name} +{kind.kind} ", table, re.MULTILINE), name
    assert "rate_per_s  0 to 30 1/s" in table and "not for rod" in table


def test_a_scene_gives_the_bounds_of_its_own_body(capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(printed(capsys, str(ROOT / "sample" / "soft_beam"), "--json"))
    assert {body for entry in document["effects"] for body in entry["bodies"]} == {"scene"}


def test_a_path_without_a_scene_is_one_line_and_an_exit_code(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([str(tmp_path / "nothing")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_page_has_every_effect_with_its_strengths() -> None:
    sections = dict(re.findall(r"^### `(\w+)`[^\n]*\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL))
    assert set(sections) == set(EFFECTS)
    for name, kind in EFFECTS.items():
        missing = {field for field in kind().values if f"`{field}`" not in sections[name]}
        assert missing == set(), name
