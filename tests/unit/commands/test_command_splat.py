"""``physworld splat``: pictures, cameras and a scene in, a splat out; known errors are one line with exit code 2."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_scene import tiny_scene

from physworld.video import Camera, Renderer, SplatView, from_ply, gaussians_at_points, orbit_view
from physworld.video.splat_start import start_from_points
from physworld_scenes.bundle import write_bundle
from physworld_workers.commands import splat
from physworld_workers.commands.video import camera_in


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    """A scene, and two cameras' pictures and masks of spheres at its points."""
    scene = tiny_scene()
    write_bundle(scene, tmp_path / "scene")
    options = [str(tmp_path / "scene"), f"--out={tmp_path / 'new' / 'splat.ply'}"]
    for number, azimuth in enumerate((20.0, 80.0)):
        camera = orbit_view(scene.points[0], azimuth, 15.0, 80, 60)
        write_camera(camera, tmp_path / f"{number}.json")
        picture = Renderer(camera).render(gaussians_at_points(scene.points[0]))
        Image.fromarray(np.round(picture.rgb * 255).astype(np.uint8)).save(tmp_path / f"{number}.png")
        Image.fromarray(np.uint8(255) * (picture.alpha > 0.5)).save(tmp_path / f"mask{number}.png")
        options += [f"--picture={tmp_path / f'{number}.png'}", f"--camera={tmp_path / f'{number}.json'}"]
        options += [f"--mask={tmp_path / f'mask{number}.png'}"]
    return options


def write_camera(camera: Camera, path: Path) -> None:
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    path.write_text(json.dumps({**numbers, "world_to_camera": camera.world_to_camera.tolist()}))


def test_it_writes_a_splat_that_shows_both_pictures(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    losses = tmp_path / "losses.json"
    assert splat.main([*given, "--steps=60", f"--json={losses}"]) == 0
    found = json.loads(losses.read_text())
    assert len(found["losses"]) == 60
    read = from_ply((tmp_path / "new/splat.ply").read_bytes())
    for number in range(2):
        camera = camera_in(tmp_path / f"{number}.json")
        picture = np.asarray(Image.open(tmp_path / f"{number}.png").convert("RGB"))
        mask = np.asarray(Image.open(tmp_path / f"mask{number}.png")) > 127
        start = start_from_points(tiny_scene().points[0], [SplatView(camera, picture, mask)], 100)
        before, after = (
            np.mean((Renderer(camera).render(gaussians).rgb - picture / 255.0)[mask] ** 2)
            for gaussians in (start, read)
        )
        assert after < 0.5 * before
    assert len(read) == found["gaussians"] and f"{len(read)} Gaussians" in capsys.readouterr().out


def test_what_does_not_fit_together_is_said(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert splat.main(given[:-1]) == 2
    assert "got 2 cameras and 1 masks" in capsys.readouterr().err
    (tmp_path / "1.png").write_bytes(b"no picture")
    assert splat.main(given) == 2
    assert "1.png is no picture" in capsys.readouterr().err
    Image.new("RGB", (3, 2)).save(tmp_path / "1.png")
    assert splat.main(given) == 2
    assert "must be of shape (60, 80, 3)" in capsys.readouterr().err
    away = [option for option in given if "0." not in option and "mask" not in option]
    Image.new("RGB", (80, 60)).save(tmp_path / "1.png")
    facts = json.loads((tmp_path / "1.json").read_text())
    facts["world_to_camera"][2][3] -= 100.0
    (tmp_path / "1.json").write_text(json.dumps(facts))
    assert splat.main(away) == 2
    assert "points lie on the object in some view" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
