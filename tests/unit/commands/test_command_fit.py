"""``physworld fit``: one process, files in, files out, and every known error one line with exit code 2."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_model import serving
from made_scene import box_body, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.discretisation import converged_parameters
from physworld.estimation.simulations import Workers
from physworld.scene import UNDEFORMED_AT_REST, Grip
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld_scenes.bundle import read_bundle, write_bundle
from physworld_workers.commands import fit
from physworld_workers.law_choice import chosen_laws
from physworld_workers.tasks.fit_accuracy import fit_accuracy, not_measured
from physworld_workers.tasks.fit_report import fit_report, parameter_json

pytestmark = pytest.mark.slow

FRAMES, BUDGET, SIMULATIONS = 16, 60, 100
YOUNGS_MODULUS_PA = 4e4
LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bar that sags from its clamp, as a folder."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[x, 0.0, 0.015] for x in np.linspace(0.03, 0.12, 7)],
        "beam",
        grip,
        FRAMES,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
    )
    scene = replace(scene, name="bar")
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    folder = tmp_path_factory.mktemp("scenes") / "bar"
    write_bundle(recorded_by(twin, scene, 2e-4), folder)
    return folder


def arguments(bundle: Path, *more: str) -> list[str]:
    return [str(bundle), "--particles", str(BUDGET), "--simulations", str(SIMULATIONS), *more]


def test_the_figures_and_the_files_of_a_fit(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures, out = tmp_path / "deep" / "fit.json", tmp_path / "twin"
    assert fit.main(arguments(bundle, "--json", str(figures), "--out", str(out))) == 0
    found = json.loads(figures.read_text())
    assert found["schema_version"] == 1 and found["scene"] == "bar"
    modulus = found["parameters"]["youngs_modulus_pa"]
    assert modulus["value"] == pytest.approx(YOUNGS_MODULUS_PA, rel=0.03) and modulus["unit"] == "Pa"
    held_out = found["held_out"]
    for metric in ("track_m", "chamfer_phystwin_m", "chamfer_l2_m"):
        assert {"static", "rigid_follow", "constant_velocity", "twin"} <= set(held_out[metric])
        assert len(held_out["per_frame"][metric]["twin"]) == held_out["frames"][1] - held_out["frames"][0]
    assert held_out["track_m"]["twin"] < 1.5 * held_out["noise_floor_m"]  # frame 0 is as noisy
    assert 0 < found["simulations"] <= SIMULATIONS
    assert found["correlations"] == {"names": ["youngs_modulus_pa"], "matrix": [[1.0]]}
    assert 0.5 < found["training"]["chi2_per_residual"] < 2.5
    assert found["law"]["elastic"] == "neo_hookean" and found["law"]["decided_by"] == "default"
    assert found["formulation"]["name"] == "total_lagrangian" and found["formulation"]["reason"]
    assert abs(found["numerics"]["equivalent_drag_per_s"]) < 0.5
    assert found["converged"]["youngs_modulus_pa"]["unit"] == "Pa"
    assert found["not_measured"] == "" and found["search"] == {"converged": True, "open": {}}
    with np.load(out / "twin.npz", allow_pickle=False) as arrays:
        twin = Twin.from_arrays(dict(arrays))
    assert twin.parameters["youngs_modulus_pa"] == modulus["value"]
    assert {path.name for path in out.iterdir()} == {"twin.npz", "prediction.npz", "report.json"}
    assert "youngs_modulus_pa" in capsys.readouterr().out


def test_several_recordings_are_fitted_together_and_reported_each(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = read_bundle(bundle)
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=1.3 * YOUNGS_MODULUS_PA)
    other = tmp_path / "stiffer"
    write_bundle(replace(recorded_by(twin, scene, 2e-4, seed=5), name="stiffer"), other)
    figures, out = tmp_path / "fit.json", tmp_path / "twin"
    more = arguments(other, "--simulations", "300", "--json", str(figures), "--out", str(out), "--quick")
    assert fit.main([str(bundle), *more]) == 0
    found = json.loads(figures.read_text())
    assert [known["scene"] for known in found["recordings"]] == ["bar", "stiffer"]
    modulus = found["parameters"]["youngs_modulus_pa"]["value"]
    assert YOUNGS_MODULUS_PA < modulus < 1.3 * YOUNGS_MODULUS_PA
    agreement = next(known for known in found["agreement"] if known["parameter"] == "youngs_modulus_pa")
    soft, stiff = agreement["recordings"]
    assert not agreement["agrees"] and soft["value"] < modulus < stiff["value"]
    assert soft["shift_in_deviations"] < 0.0 < stiff["shift_in_deviations"]
    for name in ("twin.npz", "twin_2.npz"):
        with np.load(out / name, allow_pickle=False) as arrays:
            assert Twin.from_arrays(dict(arrays)).parameters["youngs_modulus_pa"] == modulus
    assert "RECORDINGS DISAGREE ON youngs_modulus_pa" in capsys.readouterr().out


def test_a_search_that_its_budget_cut_short_is_said_in_words_and_in_figures(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tmp_path / "fit.json"
    given = [str(bundle), "--particles", str(BUDGET), "--simulations", "20", "--json", str(figures)]
    assert fit.main(given) == 0
    found = json.loads(figures.read_text())
    modulus = found["parameters"]["youngs_modulus_pa"]
    assert modulus["ci95"] is None and not modulus["identified"]
    assert not found["search"]["converged"] and found["converged"] is None and found["numerics"] is not None
    said = "youngs_modulus_pa is not converged: the search was cut short by its budget of 20 simulations"
    assert said in capsys.readouterr().out


def test_a_law_that_was_chosen_under_a_budget_that_did_not_suffice_is_not_converged(bundle: Path) -> None:
    scene = read_bundle(bundle)
    config = CalibrationConfig(particle_budget=BUDGET, max_simulations=20, damping="none")
    ended, choice = chosen_laws("auto", scene, config)
    fitted = calibrate(scene, replace(ended, max_simulations=400))
    report = fit_report(scene, fitted, choice, not_measured("left out"))
    assert not choice.ended and fitted.open == {}
    assert report["metrics"]["search"]["open"] == {"law": choice.reason}
    assert "budget of 20 simulations" in choice.reason
    assert not report["metrics"]["search"]["converged"]


def test_a_given_law_is_used_and_an_unknown_one_refused(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tmp_path / "fit.json"
    assert fit.main(arguments(bundle, "--quick", "--law", "hencky", "--json", str(figures))) == 0
    found = json.loads(figures.read_text())
    assert found["law"]["elastic"] == "hencky" and found["law"]["decided_by"] == "given"
    assert found["numerics"] is None and found["converged"] is None and "--quick" in found["not_measured"]
    capsys.readouterr()
    assert fit.main(arguments(bundle, "--law", "jelly")) == 2
    assert "no law 'jelly'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "word"), [(None, "{path}: No such file"), (b"nothing that we read", "scene.zip: is neither ")]
)
def test_what_cannot_be_read_is_one_line_and_exit_code_2(
    tmp_path: Path, content: bytes | None, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.zip"
    if content is not None:
        path.write_bytes(content)
    assert fit.main([str(path), "--json", str(tmp_path / "fit.json")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"error: {word.format(path=path)}")
    assert not (tmp_path / "fit.json").exists()


def test_a_scene_that_no_law_covers_is_one_line_and_exit_code_2(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "few"
    write_bundle(replace(made_scene(np.eye(3), "blob"), name="few"), folder)
    assert fit.main([str(folder)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "SceneUnsupported" not in said


def test_an_interrupt_cancels_and_says_so(bundle: Path, tmp_path: Path) -> None:
    figures = tmp_path / "fit.json"
    command = [
        sys.executable,
        "-m",
        "physworld_workers.commands.fit",
        *arguments(bundle, "--json", str(figures)),
    ]
    command[-1:] = [str(figures), "--particles", "4000"]  # slow enough to be met while it works
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stderr is not None
        first = next(line for line in process.stderr if line.startswith("fit bar"))
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert first.startswith("fit bar 1/")
    assert process.returncode == 130 and "cancelled; nothing was written" in rest and "Traceback" not in rest
    assert not figures.exists()


def test_an_interrupt_says_that_finished_steps_are_kept(bundle: Path, tmp_path: Path) -> None:
    journal = tmp_path / "steps.json"
    command = [
        sys.executable,
        "-m",
        "physworld_workers.commands.fit",
        *arguments(bundle, "--resume", str(journal)),
    ]
    command += ["--particles", "4000"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stderr is not None
        while not journal.exists() and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert f"no figures were written; the steps in {journal} are kept" in rest
    assert len(json.loads(journal.read_text())["entries"]) >= 1


def test_a_fit_that_was_ended_goes_on_from_its_file(bundle: Path, tmp_path: Path) -> None:
    journal = tmp_path / "deep" / "steps.json"

    def fitted(name: str, *more: str) -> dict[str, Any]:
        figures = tmp_path / name
        given = arguments(bundle, "--quick", "--json", str(figures), "--resume", str(journal), *more)
        assert fit.main(given) == 0
        found: dict[str, Any] = json.loads(figures.read_text())
        return {key: value for key, value in found.items() if key != "seconds"}

    whole = fitted("whole.json")
    stored = json.loads(journal.read_text())
    assert len(stored["entries"]) > 2
    ended = stored | {"entries": stored["entries"][:1]}
    journal.write_text(json.dumps(ended))
    assert fitted("again.json") == whole
    assert json.loads(journal.read_text()) == stored
    again = fitted("shared.json", "--processes", "2")  # shares them, and takes the same steps
    assert again == whole and json.loads(journal.read_text()) == stored
    fitted("other.json", "--simulations", "40")  # other settings: none of those steps is read
    assert json.loads(journal.read_text())["key"] != stored["key"]


@pytest.mark.parametrize("option", ["--out", "--json"])
def test_a_place_that_cannot_be_written_is_refused_before_anything_is_simulated(
    bundle: Path, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file") if option == "--out" else taken.mkdir()
    assert fit.main(arguments(bundle, "--quick", option, str(taken))) == 2
    shown = capsys.readouterr()
    assert f"{option} {taken} is a" in shown.err and shown.out == ""


def test_a_file_that_is_no_journal_is_not_overwritten(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes.json"
    notes.write_text('{"written": "by hand"}')
    assert fit.main(arguments(bundle, "--quick", "--resume", str(notes))) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert notes.read_text() == '{"written": "by hand"}'


def test_a_grip_that_a_finer_lattice_cannot_hold_leaves_the_fit(bundle: Path) -> None:
    scene = read_bundle(bundle)
    beside = scene.controllers - np.array([0.004, 0.0, 0.0])  # nearer to a coarse particle than it is large
    scene = replace(scene, controllers=beside, grips=(Grip((0, 1, 2, 3), radius_m=1e-4),))
    fitted = calibrate(scene, CalibrationConfig(particle_budget=BUDGET, max_simulations=12))
    found = fit_accuracy(scene, fitted, BUDGET)
    assert found["numerics"] is None and "a grip holds material within" in found["not_measured"]


def test_shared_runs_measure_the_same_accuracy(bundle: Path) -> None:
    scene = read_bundle(bundle)
    fitted = calibrate(scene, CalibrationConfig(particle_budget=BUDGET, damping="none"))
    alone = fit_accuracy(scene, fitted, BUDGET)
    with Workers(2) as workers:
        shared = fit_accuracy(scene, fitted, BUDGET, runner=workers)
    assert alone["numerics"].pop("seconds") > 0 and shared["numerics"].pop("seconds") > 0
    assert shared == alone
    assert alone["converged"] == {
        name: parameter_json(estimate)
        for name, estimate in converged_parameters(scene, fitted, BUDGET).items()
    }


def test_a_recording_of_three_frames_is_fitted_and_measured(bundle: Path, tmp_path: Path) -> None:
    scene = read_bundle(bundle)
    few = replace(
        scene,
        points=scene.points[:3],
        visible=scene.visible[:3],
        controllers=scene.controllers[:3],
        times=scene.times[:3],
        train=(0, 2),
        test=(2, 3),
    )
    write_bundle(few, tmp_path / "few")
    figures = tmp_path / "fit.json"
    assert fit.main(arguments(tmp_path / "few", "--json", str(figures))) == 0
    numerics = json.loads(figures.read_text())["numerics"]
    assert numerics["dominant_mode_hz"] is None and numerics["half_step_m"] is not None


def test_the_law_may_be_a_models_choice(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = "Elastic: FCR | Plastic: Purely Elastic | Reason: it turns more than it stretches"
    with serving(answer) as model:
        monkeypatch.setenv("PHYSWORLD_LAW_URL", model.url)
        monkeypatch.setenv("PHYSWORLD_LAW_MODEL", "eye-1")
        figures = tmp_path / "fit.json"
        assert fit.main(arguments(bundle, "--quick", "--law", "auto", "--json", str(figures))) == 0
        ((path, _, body),) = model.asked
    assert path == "/v1/chat/completions" and body["model"] == "eye-1"
    law = json.loads(figures.read_text())["law"]
    assert (law["elastic"], law["decided_by"]) == ("fixed_corotated", "model eye-1")
    assert law["reason"] == "it turns more than it stretches"
