"""``physworld trace A B --held-out C``: which recordings are fitted, which only measured; the files of several."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by
from physworld_client.cli import trace as command
from physworld_client.cli.app import app
from typer.testing import CliRunner

from physworld.calibrate import Journal
from physworld.errors import Cancelled
from physworld.scene import UNDEFORMED_AT_REST, Grip
from physworld.twin.build import build_twin
from physworld_scenes.bundle import read_bundle, write_bundle
from physworld_workers.commands import trace
from physworld_workers.commands.terminal import INTERRUPTED

pytestmark = pytest.mark.slow

BUDGET, FRAMES = 60, 10


def bundle(folder: Path, stroke: float, seed: int) -> Path:
    """A bar that sags and is moved by ``stroke`` [m]."""
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[x, 0.0, 0.015] for x in np.linspace(0.03, 0.12, 4)], "beam", grip, FRAMES,
        body=box_body(low, high, density_kg_m3=300.0), initial_state=UNDEFORMED_AT_REST,
        grips=(Grip((0, 1, 2, 3), low, np.array([0.02, 0.015, 0.015])),), name=folder.name,
    )  # fmt: skip
    scene = replace(scene, controllers=scene.controllers + stroke * np.sin(8 * scene.times)[:, None, None])
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=4e4)
    write_bundle(recorded_by(twin, scene, 1e-3, seed), folder)
    return folder


def test_the_files_and_the_report_of_several_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, c = (bundle(tmp_path / name, 0.004 * k, k) for k, name in enumerate("abc"))
    out, tracks = tmp_path / "report.json", tmp_path / "tracks.npz"
    options = [
        "--particles",
        str(BUDGET),
        "--processes",
        "1",
        "--out",
        str(out),
        "--predictions",
        str(tracks),
    ]
    assert trace.main([*options, "--held-out", str(c), "--", str(a), str(b)]) == 0
    report = json.loads(out.read_text())
    assert [(r["scene"], r["role"]) for r in report["recordings"]] == [
        ("a", "fitted"), ("b", "fitted"), ("c", "held_out"),
    ]  # fmt: skip
    assert report["held_out"]["after"] == report["recordings"][2]["after"]
    with np.load(tracks) as found:
        assert set(found) == {
            "before",
            "after",
            *(f"{when}_{k}" for when in ("before", "after") for k in range(3)),
        }
        assert found["after_2"].shape == (FRAMES, 4, 3) and np.array_equal(found["after"], found["after_0"])
    assert "held_out  frames 1 to 10: before" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "fitted", "unseen"),
    [
        (["a", "b", "--held-out", "c", "d"], ["a", "b"], ["c", "d"]),
        (["--held-out", "c", "d", "--particles", "60", "a"], ["a"], ["c", "d"]),
        (["a", "--held-out", "c", "--held-out", "d"], ["a"], ["c", "d"]),
        (["a"], ["a"], []),
    ],
)
def test_what_follows_held_out_is_held_out(
    monkeypatch: pytest.MonkeyPatch, given: list[str], fitted: list[str], unseen: list[str]
) -> None:
    seen: list[list[str]] = []
    monkeypatch.setattr(command, "become", lambda module, arguments: seen.append(arguments))
    assert CliRunner().invoke(app, ["trace", *given]).exit_code == 0
    found = trace._parser().parse_args(seen[0])
    assert [p.name for p in found.scenes] == fitted and [p.name for p in found.held_out] == unseen


def test_a_held_out_without_a_scene_is_refused() -> None:
    assert CliRunner().invoke(app, ["trace", "a", "--held-out"]).exit_code == 2


def test_steps_of_a_calibration_belong_to_everything_that_the_scene_declares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []

    def watched(*arguments: object, journal: Journal, **more: object) -> None:
        found.append(journal.step("a step", lambda: {"command": len(found)})["command"])
        raise Cancelled("seen")

    monkeypatch.setattr("physworld.trace.trace", watched)
    known = read_bundle(bundle(tmp_path / "a", 0.004, 0))
    heavy = replace(known, body=replace(known.body, density_kg_m3=500.0))
    light = replace(known, gravity_m_s2=np.array([0.0, 0.0, -3.7]))
    for k, scene in enumerate((known, known, heavy, light, replace(light, train=(0, 5)))):
        write_bundle(scene, tmp_path / str(k))
        given = [str(tmp_path / str(k)), "--resume", str(tmp_path / "kept"), "--processes", "1"]
        assert trace.main(given) == INTERRUPTED
    assert found == [0, 0, 2, 3, 4]


@pytest.mark.parametrize("option", ["--time-limit", "--noise"])
@pytest.mark.parametrize("wrong", ["-1", "nan", "inf", "soon"])
def test_a_time_limit_and_a_noise_are_numbers(
    option: str, wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        trace.main([f"{option}={wrong}", "--", "scene"])
    assert option in capsys.readouterr().err
