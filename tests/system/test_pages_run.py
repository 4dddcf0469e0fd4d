"""What two pages of the guide claim is run: every shell block of the tutorial and of the how-to for OptiTrack.

The commands run as they are printed, in the order of the page, in a folder of their own, with a real service and real
files. Only sizes are smaller: the recordings are short, and ``SMALL`` has the settings that are put in for the page's
or behind them. Installing is left out: the tests run in what it made.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import marker_files
import numpy as np
import pytest

from physworld_scenes.bundle import read_bundle

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INSTALL = ["make install", "export PATH=$PWD/.venv/bin:$PATH"]
FRAMES = 24
RUN = {"episodes": 3, "hidden": 8, "vertices": 8, "steps": 4, "particles": 60, "simulations": 8}
SMALL = {"run": RUN, "check": {"motions": 1, "particles": 60}}
STARTS_WITHIN_S = 120.0


class Terminal:
    """A folder in which somebody types what a page says; ``said`` is what the last command printed."""

    def __init__(self, page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.text = (ROOT / "docs" / page).read_text()
        self.folder = folder
        self.said = ""
        for name in [known for known in os.environ if known.startswith("PHYSWORLD_")]:
            monkeypatch.delenv(name)
        monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
        monkeypatch.setenv("PHYSWORLD_DATA_DIR", str(folder / "data"))
        monkeypatch.setenv("COLUMNS", "200")

    def blocks(self, language: str = "") -> list[str]:
        """Code blocks of the page."""
        return [text for named, text in BLOCK.findall(self.text) if named == language]

    def commands(self) -> list[str]:
        """Lines of all shell blocks, without those that install."""
        lines = [line for block in self.blocks() for line in block.splitlines() if line.strip()]
        return [line for line in lines if line not in INSTALL]

    def run(self, line: str) -> str:
        """One command as the page prints it, made small; what it says on its standard output."""
        words = shlex.split(line)
        for option, value in SMALL.get(words[1], {}).items():
            if f"--{option}" in words:
                words[words.index(f"--{option}") + 1] = str(value)
            else:
                words += [f"--{option}", str(value)]
        done = subprocess.run(words, cwd=self.folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        self.said = done.stdout
        return self.said


def short(scene: Path, copy: Path) -> None:
    """The first frames of a recording."""
    with np.load(scene / "scene.npz") as arrays:
        frames = len(arrays["times"])
        kept = {name: array[:FRAMES] if len(array) == frames else array for name, array in arrays.items()}
    declared = json.loads((scene / "scene.json").read_text())
    declared["split"] = {"train": [0, round(0.7 * FRAMES)], "test": [round(0.7 * FRAMES), FRAMES]}
    copy.mkdir(parents=True)
    np.savez(copy / "scene.npz", **kept)
    (copy / "scene.json").write_text(json.dumps(declared))


def test_the_tutorial_from_the_recording_to_the_dashboard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = Terminal("tutorial.md", tmp_path, monkeypatch)
    assert terminal.blocks()[0].splitlines() == INSTALL
    short(ROOT / "sample" / "soft_beam", tmp_path / "sample" / "soft_beam")
    look, run, up = terminal.commands()

    assert f"{FRAMES} frames" in terminal.run(look)

    said = terminal.run(run)
    report = json.loads((tmp_path / "report.json").read_text())
    for row in re.findall(r"^\| ([\w -]+?) \| [\d.]+ \|", terminal.text, re.MULTILINE):
        assert row in said, f"the page's table has {row}, the run printed\n{said}"
    assert report["held_out"]["track_m"]["twin"] < report["held_out"]["track_m"]["static"]
    assert "not identified" in said or "95 %" in said  # each parameter with an interval, or why it has none

    (example,) = terminal.blocks("python")
    folder = re.search(r"^model files \(verified\): (.+)$", said, re.MULTILINE)
    assert folder is not None and "path/that/was/printed" in example
    names: dict[str, object] = {}
    exec(example.replace("path/that/was/printed", folder[1]), names)
    vertices, points = names["vertices"], names["points"]
    assert isinstance(vertices, np.ndarray) and isinstance(points, np.ndarray)
    assert vertices.shape[0] == points.shape[0] == 40 and points.shape[1] == 80
    assert np.isfinite(points).all()

    with (tmp_path / "up.out").open("w") as output:
        service = subprocess.Popen(shlex.split(up), cwd=tmp_path, stdout=output, stderr=subprocess.STDOUT)
    try:
        address, told = None, ""
        until = time.monotonic() + STARTS_WITHIN_S
        while address is None and time.monotonic() < until and service.poll() is None:
            told = (tmp_path / "up.out").read_text()
            address = re.search(r"http://\S+/dashboard", told)
            time.sleep(0.2)
        assert address is not None, told
        assert "api-key" in (tmp_path / "up.out").read_text()
        key = (tmp_path / "data" / "api-key").read_text().strip()
        with httpx.Client(follow_redirects=True, trust_env=False) as browser:
            browser.headers["Accept"] = "text/html"
            assert 'name="key"' in browser.get(address[0]).text
            origin = {"Origin": address[0].removesuffix("/dashboard")}
            page = browser.post(f"{address[0]}/login", data={"key": key, "next": ""}, headers=origin)
            assert page.status_code == 200 and "soft_beam" in browser.get(f"{address[0]}/models").text
    finally:
        service.send_signal(signal.SIGINT)
        assert service.wait(60) in (0, 130)


def test_optitrack_from_the_take_to_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal("howto/optitrack.md", tmp_path, monkeypatch)
    take = marker_files.motive(marker_files.made(frames=60), version="1.25", unlabelled=2)
    take = re.sub(rb"\bM(\d+)\b", rb"Cloth\1", take.replace(b"Gripper", b"Hand"))
    (tmp_path / "take.csv").write_bytes(take)
    look, guessed, named, check, run = terminal.commands()

    said = terminal.run(look)
    assert "nothing was written" in said and not (tmp_path / "cloth").exists()
    for guess in ("up", "unit", "rate", "gripper", "body", "noise"):
        assert re.search(rf"^  {guess} .*--\w+", said, re.MULTILINE), said

    terminal.run(guessed)
    first = read_bundle(tmp_path / "cloth")
    terminal.run(named)
    scene = read_bundle(tmp_path / "cloth")
    assert scene.kind == "sheet" and scene.body.mass_kg == 0.08 and scene.body.thickness_m == 0.001
    assert scene.points.shape == first.points.shape == (60, 16, 3) and scene.controllers.shape == (60, 4, 3)

    said = terminal.run(check)
    assert "youngs_modulus_pa" in said or "bending" in said
    assert "visible" in said and "next:" in said

    terminal.run(run)
    report = json.loads((tmp_path / "cloth.json").read_text())
    assert report["held_out"]["track_m"].keys() >= {"static", "twin", "world_model"}
    assert report["model"]["version"] == 1
