"""``physworld check SCENE``: its tables, its file, and what it refuses in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from physworld_client.cli import check as command
from physworld_client.cli.app import app
from tiny_scene import tiny_scene
from typer.testing import CliRunner

from physworld_scenes.bundle import write_bundle
from physworld_workers.commands import check
from physworld_workers.commands.terminal import FAILED

pytestmark = pytest.mark.slow

SMALL = ("--particles", "60", "--processes", "1", "--motions", "0")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_bundle(tiny_scene(), tmp_path / "tiny")
    return tmp_path / "tiny"


def test_the_tables_and_the_file_say_the_same(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "made" / "check.json"
    given = [
        "--json",
        str(out),
        "--noise",
        "2e-4",
        "--discrepancy",
        "0.1",
        "--value",
        "youngs_modulus_pa=5e4",
    ]
    assert check.main([*given, *SMALL, "--", str(scene)]) == 0
    report = json.loads(out.read_text())
    assert (report["noise_m"], report["noise_is"]) == (2e-4, "given")
    assert [view["discrepancy_share"] for view in report["views"]] == [0.0, 0.1]
    told = capsys.readouterr().out
    lines = told.splitlines()
    usual = report["views"][1]
    for known in usual["parameters"]:
        (line,) = (line for line in lines if line.startswith(f"{known['name']} ["))
        assert ("(given)" in line) == (known["name"] == "youngs_modulus_pa")
        assert f"{known['expected95'][0]:.3g} to {known['expected95'][1]:.3g}" in line
    (begin,) = (k for k, line in enumerate(lines) if line.startswith("effect "))
    lines = lines[begin:]
    for effect in usual["effects"]:
        (line,) = (line for line in lines if line.split(" ")[0] == effect["label"])
        assert check.WORDS[effect["status"]] in line
    assert lines[-1].startswith(f"{report['simulations']} simulations, ")


def test_the_command_passes_on_what_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(command, "become", lambda module, arguments: seen.append((module, arguments)))
    given = [
        "check",
        "a",
        "--noise",
        "0.001",
        "--value",
        "poissons_ratio=0.4",
        "--value",
        "x=1",
        "--motions",
        "0",
    ]
    assert CliRunner().invoke(app, given).exit_code == 0
    ((module, arguments),) = seen
    assert module == check.__name__
    found = check._parser().parse_args(arguments)
    assert found.scene == Path("a") and found.noise == 0.001 and found.motions == 0
    assert found.value == [("poissons_ratio", 0.4), ("x", 1.0)]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["--noise", "nan"], "noise of nan m"),
        (["--discrepancy", "2"], "a discrepancy of 2 of the motion"),
        (["--value", "stiffness=1"], "no 'stiffness' to be calibrated; it has youngs_modulus_pa"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    scene: Path, given: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check.main([*given, *SMALL, "--", str(scene)]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
