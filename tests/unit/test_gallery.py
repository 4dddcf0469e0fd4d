"""The gallery: its page is what its script writes, its films move, and what is drawn lies in the picture."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from physworld.video import orbit_view
from scripts.gallery_objects import EXHIBITS, Exhibit, Motion
from scripts.make_gallery import FOLDER, MARGIN, PAGE, README_FILM, drawn, filled, moving_picture, page

pytestmark = pytest.mark.slow

LARGEST_BYTES = 500_000
FRAMES = 8
WHITE = 250


def rising(**facts: object) -> Motion:
    """A cube of particles that goes up by its own height."""
    line = np.linspace(0.0, 0.05, 6)
    cube = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    lift = np.linspace(0.0, 0.05, FRAMES)[:, None, None] * np.array([0.0, 0.0, 1.0])
    return Motion(np.arange(FRAMES) / 30.0, cube + lift, **facts)  # type: ignore[arg-type]


EXHIBIT = Exhibit("cube", "A cube", "It rises.", lambda budget: rising(), check_m=0.03)


def frames(film: bytes | Path, folder: Path) -> np.ndarray:
    """Pictures (T, H, W, 3) of a film."""
    if isinstance(film, bytes):
        path = folder / "film.mp4"
        path.write_bytes(film)
    else:
        path = film
    with av.open(str(path)) as opened:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)])


def middle(picture: np.ndarray) -> float:
    """Mean row of what is drawn [px]."""
    return float(np.nonzero((picture < WHITE).any(axis=-1))[0].mean())


def test_the_page_is_what_the_script_writes() -> None:
    figures = json.loads((FOLDER / "figures.json").read_text())
    assert figures.keys() == {exhibit.name for exhibit in EXHIBITS}
    assert PAGE.read_text() == page(figures), "run `python -m scripts.make_gallery`"


@pytest.mark.parametrize("name", [exhibit.name for exhibit in EXHIBITS])
def test_a_film_moves_and_is_small(name: str, tmp_path: Path) -> None:
    path = FOLDER / f"{name}.mp4"
    assert path.stat().st_size < LARGEST_BYTES and (FOLDER / f"{name}.webp").stat().st_size < LARGEST_BYTES
    pictures = frames(path, tmp_path).astype(int)
    assert len(pictures) > 20
    assert (np.abs(pictures[len(pictures) // 2] - pictures[0]).max(axis=-1) > 40).mean() > 0.005


def test_the_film_of_the_readme_is_the_first_one_of_the_gallery() -> None:
    assert README_FILM.stat().st_size <= 1_500_000
    readme = (README_FILM.parents[2] / "README.md").read_text()
    assert f"](docs/images/{README_FILM.name})" in readme
    with Image.open(README_FILM) as film:
        assert film.is_animated and film.n_frames > 20 and film.info["loop"] == 0  # type: ignore[attr-defined]
        shown = np.asarray(film.convert("RGB").resize((48, 36))).astype(int)
    with av.open(str(FOLDER / "soft_beam.mp4")) as opened:
        first = next(opened.decode(video=0)).to_image().resize((48, 36))
    assert np.abs(shown - np.asarray(first).astype(int)).mean() < 5


def test_a_moving_picture_moves(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(drawn(EXHIBIT, rising(), (96, 72))[0])
    (tmp_path / "film.webp").write_bytes(moving_picture(tmp_path / "film.mp4", (96, 72)))
    with Image.open(tmp_path / "film.webp") as film:
        count = film.n_frames  # type: ignore[attr-defined]
        first = np.asarray(film.convert("RGB"))
        film.seek(count - 1)
        last = np.asarray(film.convert("RGB"))
    assert count == FRAMES // 2 and middle(first) - middle(last) > 10


def test_what_rises_rises_in_the_film(tmp_path: Path) -> None:
    film, poster = drawn(EXHIBIT, rising(), (96, 72))
    pictures = frames(film, tmp_path)
    assert pictures.shape == (FRAMES, 72, 96, 3) and poster.shape == (72, 96, 3)
    assert middle(pictures[0]) - middle(pictures[-1]) > 15


def test_a_slower_film_has_more_seconds(tmp_path: Path) -> None:
    seconds = []
    for slower in (1.0, 4.0):
        (tmp_path / "film.mp4").write_bytes(drawn(EXHIBIT, rising(slower=slower), (96, 72))[0])
        with av.open(str(tmp_path / "film.mp4")) as film:
            seconds.append(film.duration or 0)
    assert seconds[1] == pytest.approx(4 * seconds[0], rel=0.01)


def test_measured_points_are_dark_where_they_are_visible(tmp_path: Path) -> None:
    motion = rising()
    nearest = int(np.argmax(motion.particles[0] @ [1.0, -1.0, 1.0]))  # the corner before the camera
    points, seen = motion.particles[:, [nearest]] + [0.004, -0.004, 0.004], np.ones((FRAMES, 1), dtype=bool)
    dark = [
        int((drawn(EXHIBIT, rising(measured=(points, visible)), (320, 240))[1].max(axis=-1) < 80).sum())
        for visible in (seen, ~seen)
    ]
    assert dark[0] > dark[1] + 3


def test_what_is_shown_fills_the_picture_up_to_its_margin() -> None:
    view = rising().particles.reshape(-1, 3)
    camera = filled(orbit_view(view, -60.0, 20.0, 320, 240), view)
    pixels = camera.project(view)[0] / [camera.width, camera.height]
    assert pixels.min() == pytest.approx(MARGIN, abs=1e-6)
    assert pixels.max() == pytest.approx(1.0 - MARGIN, abs=1e-6)
