"""The commands of docs/markers.md are run, and its lists are what the importers do."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import marker_files as files
import numpy as np
import pytest

from physworld.twin.build import build_twin
from physworld_scenes.bundle import read_bundle
from physworld_scenes.importers.tables import table, text
from physworld_scenes.importers.tables.belonging import MOST_COMPARED
from physworld_scenes.importers.tables.facts import COVERED_BY
from physworld_scenes.importers.tables.guesses import REST_FRAMES

pytestmark = pytest.mark.slow

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "markers.md").read_text()
COMMANDS = re.findall(r"^physworld (import .*)$", PAGE, re.MULTILINE)
MOST_WORDS = 700


def rope() -> bytes:
    """Columns of a rope between two driven ends, E1 and E2, with R1 to R5 between them, in their order."""
    times = np.arange(80) / 100.0
    sag = 0.1 * np.sin(np.linspace(0.0, np.pi, 7)) * (1.0 + 0.2 * np.sin(7 * times[:, None]))
    places = np.stack(
        [np.linspace(0, 0.6, 7) + 0 * sag, 0.05 * np.sin(3 * times[:, None]) + 0 * sag, 1.0 - sag], axis=2
    )
    names = ["E1", "R1", "R2", "R3", "R4", "R5", "E2"]
    rows = [",".join(["time", *(f"{name}_{axis}_m" for name in names for axis in "xyz")])]
    rows += [
        ",".join([f"{t:.3f}", *(f"{v:.6f}" for v in frame.ravel())])
        for t, frame in zip(times, places, strict=True)
    ]
    return "\n".join(rows).encode()


def test_the_commands_of_the_page_do_what_it_says(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_bytes(files.motive(files.made(), version="1.25", unlabelled=2))
    (tmp_path / "rope.csv").write_bytes(rope())
    assert len(COMMANDS) == 3
    said = []
    for line in COMMANDS:
        program = ["-c", "from physworld_client.cli.app import main; main()"]
        command = [sys.executable, *program, *shlex.split(line)]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, (line, ended.stderr)
        said.append(ended.stdout)
    assert "nothing was written" in said[0] and "--gripper" in said[0]
    cloth, line = read_bundle(tmp_path / "cloth"), read_bundle(tmp_path / "rope")
    assert cloth.points.shape[1] == 16 and cloth.controllers.shape[1] == 4 and cloth.body.mass_kg == 0.08
    assert line.points.shape[1] == 7 and line.controllers.shape[1] == 2
    assert line.body.density_kg_m3 == 1100.0 and len(line.body.segment_rest_lengths_m) == 6
    for scene in (cloth, line):
        body = build_twin(scene).body
        assert np.isfinite(body.start).all() and body.thickness_m in (
            scene.body.thickness_m,
            scene.body.radius_m,
        )


def test_the_page_has_the_limits_of_the_code_and_no_more_words_than_it_may() -> None:
    assert len(PAGE.split()) <= MOST_WORDS
    assert f"{text.MOST_BYTES >> 20} MiB of text" in PAGE
    assert f"{table.MOST_MARKERS:,} markers".replace(",", " ") in PAGE
    assert f"{table.MOST_VALUES // 10**6} million coordinates" in PAGE
    assert f"beyond {MOST_COMPARED} markers" in PAGE
    assert f"{REST_FRAMES} frames at rest" in PAGE
    assert f"fewer than {COVERED_BY} markers" in PAGE
