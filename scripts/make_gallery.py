"""``python -m scripts.make_gallery [--readme] [NAME ...]``: the films and the page of the gallery, ``docs/gallery.md``.

Every film is simulated anew (``gallery_objects.py``) and drawn by the renderer of ``physworld video``: the body's
surface (``gallery_surface.py``), or grains as spheres, with colours that are carried along, and measured points dark on
top. ``docs/images/gallery`` gets NAME.mp4 and the picture NAME.webp that stands for it, and ``figures.json`` what was
measured. With names, only these are made anew. ``--readme`` simulates nothing: it makes the picture that moves at the
top of the README from the film that is there; every other call makes it too.
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import warp as wp
from PIL import Image

from physworld.arrays import Array
from physworld.video import (
    Camera,
    Gaussians,
    Renderer,
    encode_mp4,
    frames_per_second,
    gaussians_at_points,
    orbit_view,
)
from scripts.gallery_objects import BALL_RADIUS_M, EXHIBITS, Exhibit, Motion
from scripts.gallery_surface import DrawnSurface, lit

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "images" / "gallery"
PAGE = ROOT / "docs" / "gallery.md"
SIZE_PX = (640, 480)
INK, BALL, TABLE = (0.10, 0.11, 0.14), (0.45, 0.48, 0.55), (0.86, 0.87, 0.90)
MARGIN = 0.06  # of the picture that stays free on each side
MARK = 0.006  # size of a measured point, as a share of what is shown
BEFORE = 2.0  # sizes that a measured point is drawn nearer to the camera, lest the body around it hides it
POSTER_AT = 0.55  # share of the film
FRAMES_A_SECOND = 30.0  # at most; recordings have more
README_FILM = ROOT / "docs" / "images" / "soft_beam_film.webp"
README_SIZE_PX = (480, 360)
README_RATE = 15.0  # frames a second
HEAD = """# Gallery

Six objects, simulated by the engine and drawn by the renderer of [physworld video](video.md), with the surfaces that
the dashboard gives them; sand is drawn grain by grain. A click on a picture plays its film.
`python -m scripts.make_gallery` makes the films and this page.

<!-- gallery: begin -->
"""


def main() -> None:
    """Make the films that were asked for, then the page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "names", nargs="*", help=f"of {', '.join(one.name for one in EXHIBITS)}; default: all"
    )
    parser.add_argument("--readme", action="store_true", help="only the moving picture of the README")
    given = parser.parse_args()
    if given.readme:
        README_FILM.write_bytes(moving_picture(FOLDER / "soft_beam.mp4"))
        return
    names = set(given.names)
    unknown = names - {one.name for one in EXHIBITS}
    if unknown:
        parser.error(f"no exhibit is called {', '.join(sorted(unknown))}")
    wp.config.quiet = True
    FOLDER.mkdir(parents=True, exist_ok=True)
    figures = _figures()
    for exhibit in EXHIBITS:
        if not names or exhibit.name in names:
            motion = exhibit.make(exhibit.particles)
            film, poster = drawn(exhibit, motion)
            (FOLDER / f"{exhibit.name}.mp4").write_bytes(film)
            Image.fromarray(poster).save(FOLDER / f"{exhibit.name}.webp", quality=82, method=6)
            figures[exhibit.name] = _measured(motion)
            print(
                f"{exhibit.name}: {len(motion.times)} frames, {len(film) / 1e3:.0f} kB, {figures[exhibit.name]}",
                flush=True,
            )
            (FOLDER / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    PAGE.write_text(page(figures))
    README_FILM.write_bytes(moving_picture(FOLDER / "soft_beam.mp4"))


def moving_picture(film: Path, size_px: tuple[int, int] = README_SIZE_PX) -> bytes:
    """A film as an animated WebP that starts by itself and repeats: GitHub shows no MP4 of a repository in a page."""
    with av.open(str(film)) as opened:
        stream = opened.streams.video[0]
        every = max(1, round(float(stream.average_rate or FRAMES_A_SECOND) / README_RATE))
        pictures = [
            frame.to_image().resize(size_px, Image.Resampling.LANCZOS)
            for number, frame in enumerate(opened.decode(stream))
            if number % every == 0
        ]
        rate = float(stream.average_rate or FRAMES_A_SECOND) / every
    written = io.BytesIO()
    pictures[0].save(
        written, format="WEBP", save_all=True, append_images=pictures[1:], duration=round(1e3 / rate), loop=0,
        quality=70, method=6,
    )  # fmt: skip
    return written.getvalue()


def drawn(exhibit: Exhibit, motion: Motion, size_px: tuple[int, int] = SIZE_PX) -> tuple[bytes, Array]:
    """The film, MP4, and one of its frames (H, W, 3), 8 bit."""
    rate = frames_per_second(motion.times)
    every = max(1, round(rate / (FRAMES_A_SECOND * motion.slower)))
    shown = range(0, len(motion.times), every)
    view = np.concatenate([motion.particles[shown[0] :: every].reshape(-1, 3), *_ball_box(motion)])
    camera = filled(orbit_view(view, exhibit.azimuth_deg, exhibit.elevation_deg, *size_px), view)
    renderer = Renderer(camera)
    toward = camera.centre - view.mean(axis=0)
    toward /= np.linalg.norm(toward)
    body = _body(exhibit, motion, camera)
    still = [_table(motion)] if motion.ground_m is not None else []
    outward = _directions(2500)
    ball = lit(np.array(BALL), outward, toward)
    pictures = []
    for frame in shown:
        parts = [*still, body(motion.particles[frame])]
        if motion.ball is not None:
            parts.append(_spheres(motion.ball[frame] + BALL_RADIUS_M * outward, 0.05 * BALL_RADIUS_M, ball))
        if motion.measured is not None:
            points, visible = motion.measured
            if visible[frame].any():
                size = MARK * float(np.ptp(view, axis=0).max())
                before = points[frame, visible[frame]] + BEFORE * size * toward
                parts.append(_spheres(before, size, INK))
        pictures.append(np.round(renderer.render(_joined(parts)).rgb * 255.0).astype(np.uint8))
    return encode_mp4(pictures, rate / every / motion.slower), pictures[
        round(POSTER_AT * (len(pictures) - 1))
    ]


def filled(camera: Camera, view: Array) -> Camera:
    """The camera with focal length and centre such that the points (P, 3) fill the picture up to a margin."""
    pixels = camera.project(view)[0]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    size = np.array([camera.width, camera.height])
    zoom = float(np.min((1.0 - 2.0 * MARGIN) * size / (high - low)))
    middle = 0.5 * (low + high)
    cx, cy = 0.5 * size + zoom * (np.array([camera.cx, camera.cy]) - middle)
    return replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy, cx=float(cx), cy=float(cy))


def page(figures: dict[str, Any]) -> str:
    """The gallery's page."""
    parts = [HEAD]
    for exhibit in EXHIBITS:
        film = f"images/gallery/{exhibit.name}"
        text = exhibit.caption
        if (found := figures.get(exhibit.name)) and "track_error_mm" in found:
            share = 100 * found["held_out_share"]
            text += (
                f" Its mean error on the held-out frames, the last {share:.0f} % of the film, is"
                f" {found['track_error_mm']:.2f} mm; the noise of the tracking alone gives"
                f" {found['noise_floor_mm']:.2f} mm."
            )
        parts.append(f"## {exhibit.title}\n\n[![{exhibit.title}]({film}.webp)]({film}.mp4)\n\n{text}\n")
    return "\n".join([*parts, "<!-- gallery: end -->\n"])


def _figures() -> dict[str, Any]:
    path = FOLDER / "figures.json"
    return dict(json.loads(path.read_text())) if path.is_file() else {}


def _measured(motion: Motion) -> dict[str, float]:
    found: dict[str, float] = {"seconds": float(motion.times[-1]), "particles": motion.particles.shape[1]}
    if motion.held_out is not None and motion.first_held_out is not None:
        error, floor = motion.held_out
        found |= {"track_error_mm": round(1e3 * error, 2), "noise_floor_mm": round(1e3 * floor, 2)}
        found["held_out_share"] = round(1.0 - motion.first_held_out / len(motion.times), 3)
    return found


def _checks(points: Array, exhibit: Exhibit) -> Array:
    """Colours (P, 3) in two tones, by cells of the body at the start: what is deformed is seen on them."""
    place = (points - points.min(axis=0)) / exhibit.check_m
    odd = np.floor(place + 1e-6).astype(int).sum(axis=1) % 2 == 1
    tone = np.asarray(exhibit.colour)
    return np.where(odd[:, None], tone, 0.62 * tone)


def _body(exhibit: Exhibit, motion: Motion, camera: Camera) -> Callable[[Array], Gaussians]:
    """What draws the body when its particles are at (P, 3) [m]."""
    if motion.surface is None:
        spheres = gaussians_at_points(motion.particles[0], _checks(motion.particles[0], exhibit))
        return lambda particles: replace(spheres, means=particles)
    surface = DrawnSurface(motion.surface, motion.particles[0], camera.centre)
    colours = _checks(surface.middles, exhibit)
    return lambda particles: surface.at(particles, colours)


def _spheres(points: Array, radius_m: float, colour: Array | tuple[float, float, float]) -> Gaussians:
    """Points (P, 3) of one size, in one colour or in one each, (P, 3)."""
    made = gaussians_at_points(points, np.broadcast_to(colour, (len(points), 3)))
    return Gaussians(
        made.means,
        np.full((len(points), 3), np.log(radius_m)),
        made.rotations,
        made.opacity_logits,
        made.harmonics,
    )


def _table(motion: Motion) -> Gaussians:
    """A flat disc on the ground below everything that moves."""
    assert motion.ground_m is not None
    low, high = motion.particles.min(axis=(0, 1)), motion.particles.max(axis=(0, 1))
    middle, reach = 0.5 * (low + high), 0.75 * float(np.max(high - low))
    line = np.linspace(-reach, reach, 121)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[np.linalg.norm(grid, axis=1) <= reach]
    points = np.column_stack([grid + middle[:2], np.full(len(grid), motion.ground_m)])
    flat = _spheres(points, float(line[1] - line[0]), TABLE)
    flat.log_scales[:, 2] = np.log(1e-4)
    return flat


def _ball_box(motion: Motion) -> list[Array]:
    return [] if motion.ball is None else [motion.ball - BALL_RADIUS_M, motion.ball + BALL_RADIUS_M]


def _directions(count: int) -> Array:
    """Unit vectors (count, 3), evenly over the sphere (Fibonacci)."""
    number = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5.0**0.5) * number
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _joined(parts: list[Gaussians]) -> Gaussians:
    fields = ("means", "log_scales", "rotations", "opacity_logits", "harmonics")
    return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


if __name__ == "__main__":
    main()
