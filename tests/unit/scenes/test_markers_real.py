"""Measured recordings, written out in Motive's layout and imported back: skipped where there are none beside the
checkout.
"""

from __future__ import annotations

from pathlib import Path

import marker_files as files
import numpy as np
import pytest

from physworld_scenes.bundle import read_bundle
from physworld_scenes.importers import ImportOptions, import_any
from physworld_workers.commands import importing

pytestmark = pytest.mark.slow

REAL = Path(__file__).resolve().parents[4] / "shared" / "data" / "real"
HALF_A_DIGIT_M = 5.1e-7
"""Motive writes six digits of a metre."""


def recordings() -> list[Path]:
    return sorted(path.parent for path in REAL.glob("*/scene.json"))


def written(folder: Path) -> tuple[files.Motion, bytes]:
    scene = read_bundle(folder)
    points = np.where(scene.visible[..., None], scene.points, np.nan)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    motion = files.Motion(scene.times, points, scene.controllers, scene.controllers[:, 0], turns)
    return motion, files.motive(motion, version="1.25", pose=False, measured=False)


@pytest.mark.skipif(not recordings(), reason=f"no measured recordings in {REAL}")
@pytest.mark.parametrize("folder", recordings(), ids=lambda path: path.name)
def test_a_measured_recording_comes_back_from_motives_layout(folder: Path) -> None:
    measured = read_bundle(folder)
    _, data = written(folder)
    scene, _ = import_any(data, "take.csv", ImportOptions(kind=measured.kind))
    assert np.array_equal(scene.visible, measured.visible)
    assert np.abs(scene.points - measured.points)[measured.visible].max() < HALF_A_DIGIT_M
    assert np.abs(scene.controllers - measured.controllers).max() < HALF_A_DIGIT_M
    assert np.abs(scene.times - measured.times).max() < HALF_A_DIGIT_M


@pytest.mark.skipif(not (REAL / "rope_a_ring").is_dir(), reason=f"no rope_a_ring in {REAL}")
def test_the_command_makes_a_rope_that_knows_its_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = read_bundle(REAL / "rope_a_ring")
    source, out = tmp_path / "take.csv", tmp_path / "scene"
    source.write_bytes(written(REAL / "rope_a_ring")[1])
    said = ["--kind=rope", "--mass=0.05", "--radius=0.004", "--gripper=Gripper", f"--out={out}"]
    assert importing.main([str(source), *said]) == 0
    printed = capsys.readouterr().out
    assert "Motive's convention" in printed and "along it, as listed" in printed
    scene = read_bundle(out)
    assert scene.body.segment_rest_lengths_m is not None
    assert np.allclose(scene.body.segment_rest_lengths_m, measured.body.segment_rest_lengths_m, atol=2e-3)
