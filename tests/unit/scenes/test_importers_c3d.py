"""C3D motion capture written by ezc3d and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest

from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import ImportOptions, c3d, import_any, library
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.tables.scene import fill_gaps

FRAMES = 30
LABELS = ["tip1", "tip2", "tip3", "base1", "base2", "base3"]
FLOAT32 = 1e-6  # metres: C3D stores float32 millimetres


def markers() -> np.ndarray:
    """A tip that swings 10 cm from a fixed base [m], (T, 6, 3)."""
    t = np.arange(FRAMES) / 100.0
    base = np.array([[0.0, 0.0, 1.0], [0.0, 0.03, 1.0], [0.0, 0.0, 1.03]])
    tip = base + np.array([0.1, 0.0, 0.0])
    swing = np.zeros((FRAMES, 1, 3))
    swing[:, 0, 2] = 0.01 * np.sin(20 * t)
    return np.concatenate([tip + swing, np.repeat(base[None], FRAMES, axis=0)], axis=1)


def write(
    path: Path,
    positions: np.ndarray,
    *,
    labels: list[str] | None = None,
    units: str = "mm",
    per_metre: float = 1000.0,
    gaps: list[tuple[int, int]] | None = None,
) -> bytes:
    """A C3D file of (T, N, 3) metres; ``gaps`` are (frame, marker)."""
    names = LABELS if labels is None else labels
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = names
    c3d.add_parameter("POINT", "UNITS", [units])
    content = np.ones((4, len(names), len(positions)))
    content[:3] = positions.transpose(2, 1, 0) * per_metre
    for frame, marker in gaps or []:
        content[:3, marker, frame] = np.nan
    c3d["data"]["points"] = content
    c3d.write(str(path))
    return path.read_bytes()


def test_millimetres_become_metres_and_base_markers_controllers(tmp_path: Path) -> None:
    data = write(tmp_path / "swing.c3d", markers())
    box = {"box_min_m": [0, 0, 1], "box_max_m": [0.1, 0.03, 1.03], "density_kg_m3": 1000.0}
    scene, warnings = import_any(data, "swing.c3d", ImportOptions(kind="beam", body=box))
    assert (scene.name, scene.kind, scene.fps) == ("swing", "beam", 100.0)
    assert np.allclose(scene.points, markers()[:, :3], atol=FLOAT32)
    assert np.allclose(scene.controllers, markers()[:, 3:], atol=FLOAT32)
    assert scene.visible.all()
    assert scene.times[-1] == pytest.approx(0.29)
    assert scene.declared["notes"]["controller_labels"] == ["base1", "base2", "base3"]
    assert not [w for w in warnings if "controllers" in w]


def test_gaps_are_invisible_and_interpolated(tmp_path: Path) -> None:
    data = write(tmp_path / "gaps.c3d", markers(), gaps=[(5, 0), (6, 0), (9, 4)])
    scene, _ = import_any(data, "gaps.c3d")
    assert np.argwhere(~scene.visible).tolist() == [[5, 0], [6, 0]]
    one, two = scene.points[4, 0], scene.points[7, 0]
    assert np.allclose(scene.points[5, 0], one + (two - one) / 3, atol=FLOAT32)
    assert np.allclose(scene.controllers[9, 1], markers()[9, 4], atol=FLOAT32)
    assert scene.declared["notes"]["controller_samples_interpolated"] == 1


def test_a_group_that_stays_is_the_clamp_and_two_that_move_must_be_told(tmp_path: Path) -> None:
    letters = ["a", "b", "c", "d", "e", "f"]
    data = write(tmp_path / "a.c3d", markers(), labels=letters)
    scene, _ = import_any(data, "a.c3d")
    assert scene.declared["notes"]["controller_labels"] == ["d", "e", "f"]
    moving = markers()
    moving[:, 3:, 1] += 0.02 * np.cos(9 * np.arange(FRAMES)[:, None] / 100.0)
    data = write(tmp_path / "b.c3d", moving, labels=letters)
    with pytest.raises(SceneInvalid, match=r"2 groups keep their distances.*a, b, c, d, e, f"):
        import_any(data, "a.c3d")
    scene, _ = import_any(data, "a.c3d", ImportOptions(controllers=("d", "e", "f")))
    assert np.allclose(scene.controllers, moving[:, 3:], atol=FLOAT32)
    with pytest.raises(SceneInvalid, match="no marker x"):
        import_any(data, "a.c3d", ImportOptions(controllers=("d", "x")))
    with pytest.raises(SceneInvalid, match="no marker is left on the body; 6 of 6"):
        import_any(data, "a.c3d", ImportOptions(controllers=tuple(letters)))


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_named_axis_points_up_afterwards(up: str, tmp_path: Path) -> None:
    rotation = ROTATION_FROM_UP[up]
    axis = "xyz".index(up[-1])
    assert rotation @ (np.eye(3)[axis] * (-1 if up[0] == "-" else 1)) == pytest.approx([0, 0, 1])
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    data = write(tmp_path / "up.c3d", markers() @ rotation)  # R^-1 x for rows
    scene, _ = import_any(data, "up.c3d", ImportOptions(up=up))
    assert np.allclose(scene.points, markers()[:, :3], atol=FLOAT32)


def test_an_unknown_unit_or_axis_is_named(tmp_path: Path) -> None:
    data = write(tmp_path / "u.c3d", markers(), units="furlong")
    with pytest.raises(SceneInvalid, match="furlong"):
        import_any(data, "u.c3d")
    with pytest.raises(SceneInvalid, match="'w'"):
        import_any(write(tmp_path / "w.c3d", markers()), "w.c3d", ImportOptions(up="w"))


def test_metres_called_millimetres_are_noticed(tmp_path: Path) -> None:
    data = write(tmp_path / "m.c3d", markers(), units="mm", per_metre=1.0)
    with pytest.raises(SceneInvalid, match=r"less than 0\.001 m"):
        import_any(data, "m.c3d")
    assert np.allclose(import_any(data, "m.c3d", ImportOptions(unit="m"))[0].points, markers()[:, :3])


@pytest.mark.parametrize("keep", [100, 512, 1024, 2500])
def test_a_file_cut_short_is_named(keep: int, tmp_path: Path) -> None:
    data = write(tmp_path / "cut.c3d", markers())
    assert keep < len(data)
    with pytest.raises(SceneInvalid):
        import_any(data[:keep], "cut.c3d")


def test_a_forged_header_ends_the_child_and_not_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(c3d, "_check_parameters", lambda *_: None)
    data = bytearray(write(tmp_path / "forged.c3d", markers()))
    data[512 + 4 : 700] = bytes([0xFF]) * (700 - 516)
    with pytest.raises(SceneInvalid) as caught:
        import_any(bytes(data), "forged.c3d")
    assert caught.value.faults[0].loc == ["c3d"]


@pytest.mark.parametrize("bent", ["counts", "no values", "description"])
def test_a_parameter_that_does_not_end_within_the_file_is_refused_before_the_library_reads_it(
    bent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library would count to the end of values that are not there, or take 4 GiB for a text of -1 characters."""
    data = bytearray(write(tmp_path / "swing.c3d", markers()))
    import_any(bytes(data), "swing.c3d")
    at = data.index(b"LABELS") + len(b"LABELS")  # distance (2), bytes of a value (1), dimensions (1), counts
    if bent == "counts":
        data[at + 3 : at + 9] = bytes([5, 255, 255, 255, 255, 255])
    elif bent == "no values":
        data[at + 3 : at + 9] = bytes([5, 255, 255, 255, 255, 0])
    else:
        across, along = data[at + 4 : at + 6]
        data[at + 6 + across * along] = 255
    monkeypatch.setattr(library, "_in_child", lambda *_: pytest.fail("the library was asked"))
    with pytest.raises(
        SceneInvalid, match=r"cut short: \d+ bytes, a parameter at byte \d+ does not end within them"
    ):
        import_any(bytes(data), "swing.c3d")


def test_gaps_at_the_ends_are_held() -> None:
    positions: Any = np.arange(5.0)[:, None, None] * np.ones((1, 1, 3))
    valid = np.array([[False], [True], [False], [True], [False]])
    assert fill_gaps(positions, valid)[:, 0, 0].tolist() == [1, 1, 2, 3, 3]
