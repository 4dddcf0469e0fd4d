"""``physworld run`` with everything real and small: service, fit, demonstrations, training, download."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime
import psutil
import pytest
from physworld_client.world_model import WorldModel
from safetensors.numpy import load_file

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

COMMAND = Path(sys.executable).with_name("physworld")
SMALL = ("--episodes", "3", "--simulations", "6", "--steps", "20", "--vertices", "30", "--hidden", "16")
ROWS = {"static", "rigid_follow", "constant_velocity", "twin", "world_model", "world_model_finetuned"}
ENDED_WITHIN_S = 30.0
STEP_AGREEMENT_M = 1e-5


def command(scene: Path, data: Path, *options: str) -> list[str]:
    """The command line on a small particle budget."""
    return [str(COMMAND), "run", str(scene), "--data", str(data), "--particles", "300", *SMALL, *options]


def environment() -> dict[str, str]:
    """Without settings of another service; one thread a process."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")}
    return {**kept, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


def processes_of(data: Path) -> list[str]:
    """Command lines of the processes that were started on a data folder, by their environment."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("PHYSWORLD_DATA_DIR") == str(data) or str(data) in process.cmdline():
                found.append(" ".join(process.cmdline()))
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue
    return found


def one_step(step: onnxruntime.InferenceSession, folder: Path, model: WorldModel) -> np.ndarray:
    """Object vertices one tick after the start [m], the grips standing still, by the ONNX program."""
    tensors = load_file(folder / "model.safetensors")
    neighbours = tensors["graph.turned_neighbours" if "graph.frame_shape" in tensors else "graph.neighbours"]
    receivers, slots = np.nonzero(neighbours < len(neighbours))
    origin = model.start_history[-1].mean(axis=0)
    if model.ground_height_m is not None:
        origin[2] = model.ground_height_m
    controls = model.start_controllers[:, model.control_index] - origin
    window = np.concatenate([model.start_history - origin, controls], axis=1).astype(np.float32)
    inputs = {
        "window": window,
        "control_next": window[-1, len(model.rest_vertices) :],
        "phi": model.phi.astype(np.float32),
        "senders": neighbours[receivers, slots],
        "receivers": receivers,
        "kinds": tensors["graph.edge_kind"][receivers, slots],
        "rest_relative": tensors["graph.rest_relative"][receivers, slots],
    }
    (following,) = step.run(None, inputs)
    return following[: len(model.rest_vertices)] + origin


def test_from_a_recording_to_a_world_model(repository: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    report_file = tmp_path / "report.json"
    done = subprocess.run(
        command(repository / "sample" / "soft_beam", data, "--json", str(report_file)),
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "world model, fine-tuned" in done.stdout
    report = json.loads(report_file.read_text())
    for metric in ("track_m", "chamfer_phystwin_m", "chamfer_l2_m"):
        assert set(report["held_out"][metric]) >= ROWS
    assert report["held_out"]["track_m"]["twin"] < report["held_out"]["track_m"]["static"]
    assert report["steps_per_second"]["twin"] > 0 and report["steps_per_second"]["world_model"] > 0
    assert set(report["seconds"]) == {"fit", "dataset", "training", "total"}
    assert (report["episodes"], report["model"]["name"], report["model"]["version"]) == (3, "soft_beam", 1)

    model = WorldModel.load(data / "models" / "soft_beam-1", sha256=report["model"]["sha256"])
    controllers = np.repeat(model.start_controllers[-1:], 10, axis=0)
    vertices = model.rollout(np.concatenate([model.start_controllers, controllers]))
    assert vertices.shape == (10 + model.history + 1, len(model.rest_vertices), 3)
    assert np.isfinite(model.track(vertices)).all()
    folder = data / "models" / "soft_beam-1"
    step = onnxruntime.InferenceSession(folder / "step.onnx", providers=["CPUExecutionProvider"])
    assert np.abs(one_step(step, folder, model) - vertices[model.history + 1]).max() < STEP_AGREEMENT_M
    assert processes_of(data) == [], "the service ends with the command that started it"


def test_ctrl_c_cancels_the_job_and_ends_the_service(repository: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    with subprocess.Popen(
        command(repository / "sample" / "soft_beam", data),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as running:
        assert running.stdout is not None and running.stderr is not None
        for line in running.stdout:
            if line.startswith("fit      running"):
                break
        os.killpg(running.pid, signal.SIGINT)
        errors = running.stderr.read()
        assert running.wait(ENDED_WITHIN_S) == 130
    assert "is cancelled" in errors
    assert "Traceback" not in errors
    assert processes_of(data) == []


def test_a_killed_command_takes_its_service_with_it(repository: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    with subprocess.Popen(
        command(repository / "sample" / "soft_beam", data),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as running:
        assert running.stdout is not None
        for line in running.stdout:
            if line.startswith("job:"):
                break
        running.kill()
    deadline = time.monotonic() + ENDED_WITHIN_S
    while processes_of(data) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert processes_of(data) == []
