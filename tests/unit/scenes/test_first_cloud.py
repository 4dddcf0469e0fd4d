"""The cloud that a look at pictures with depth shows: few points, in the world of the scene that an import makes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import table_pictured
import tracking_pictured

from physworld.tracking.view import Box
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.first_cloud import MOST_POINTS, first_cloud

DEPTH_M = 2e-3
"""Whole millimetres of depth, and a plane fitted to them."""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    table_pictured.write(tmp_path / "table")
    return tmp_path / "table"


def test_the_ground_is_at_zero_and_the_block_stands_on_it(table: Path) -> None:
    box = Box(*table_pictured.block_box())
    found = first_cloud(table, None, {0: box})
    assert found.ground == 0.0 and found.up == "the normal of the ground in the first picture"
    assert 0.8 * MOST_POINTS < len(found.places) <= MOST_POINTS and not found.warnings
    columns, rows = found.pixels.T
    block = table_pictured.first()[2][rows, columns]
    inside = (columns >= box.left) & (columns < box.right) & (rows >= box.top) & (rows < box.bottom)
    assert (inside[block]).all()
    assert np.abs(found.places[~block, 2]).max() < 3 * DEPTH_M
    low, high = found.places[block].min(axis=0), found.places[block].max(axis=0)
    assert np.allclose(high, table_pictured.HIGH, atol=0.012)
    assert np.allclose(low[:2], table_pictured.LOW[:2], atol=0.012)
    assert np.array_equal(found.colours, table_pictured.first()[0][rows, columns])


def test_an_axis_that_is_given_points_up(table: Path) -> None:
    """Up of the camera itself: the table is no ground then, which is steeper than a level one may be."""
    found = first_cloud(table, "-y", {})
    assert found.ground is None and found.up == "-y of the cameras' world, given"
    turned = first_cloud(table, "y", {})
    assert np.allclose(turned.places[:, 2], -found.places[:, 2])
    with pytest.raises(SceneInvalid, match="up: 'w'"):
        first_cloud(table, "w", {})


def test_without_a_ground_that_is_said(tmp_path: Path) -> None:
    tracking_pictured.write(tmp_path / "plate")
    found = first_cloud(tmp_path / "plate", None, {})
    assert found.ground is None and "no ground is seen" in found.warnings[0]
    assert np.isclose(np.unique(found.places[:, 1].round(3)), [0.5, 1.2]).all()


def test_a_film_is_decoded_as_far_as_its_first_frame(table: Path) -> None:
    av = pytest.importorskip("av")
    (table / "color/0.png").unlink(), (table / "color/1.png").unlink()
    with av.open(str(table / "color/0.mp4"), "w") as film:
        stream = film.add_stream("mpeg4", rate=30)
        stream.width, stream.height = table_pictured.WIDTH, table_pictured.HEIGHT
        for shown in (table_pictured.first()[0], *[np.zeros((240, 320, 3), np.uint8)] * 9):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(shown, "rgb24")))
        film.mux(stream.encode())
    found = first_cloud(table, None, {})
    assert found.ground == 0.0 and found.colours.mean() > 60


def test_what_is_damaged_is_refused_by_its_name(table: Path) -> None:
    (table / "depth/0.png").write_bytes((table / "depth/0.png").read_bytes()[:400])
    with pytest.raises(SceneInvalid, match=r"0\.png.*damaged"):
        first_cloud(table, None, {})
    (table / "camera_intrinsic.json").unlink()
    with pytest.raises(SceneInvalid):
        first_cloud(table, None, {})


def test_a_process_that_looks_needs_no_opencv() -> None:
    """Installations without the extra `video` look at pictures, too."""
    code = "import sys, physworld_scenes.importers.first_cloud; print(*({'cv2', 'torch'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
