"""Milliseconds a frame of 640 x 480 px for splats of several sizes: carried by vertices, rendered, encoded; one thread.

Beside it the kernel that takes a thread for every pixel, and a plain numpy renderer, vectorised over the pixels that a
Gaussian covers, with the same order, the same reach and the same picture to about a step of 8 bits: what one would
write without a kernel. Times are the process's own CPU time.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from physworld.video import Camera, GaussianCarrier, Gaussians, Renderer, encode_mp4, orbit_view
from physworld.video.blending import blended
from physworld.video.render import rotation_matrices

SIZES = (2_000, 20_000, 100_000)
PLAIN = 2_000  # the plain renderer's size
BY_PIXEL = 20_000  # and that at which the kernels are compared
VERTICES = 500
WIDTH, HEIGHT = 640, 480
FILM_FRAMES = 10


def measure(repeats: int, seed: int) -> Report:
    """Every size and the plain renderer in turn."""
    wp.config.quiet = True
    rng = np.random.default_rng(seed)
    rest = ball(VERTICES, rng)
    moved = rest * [1.1, 0.9, 1.0] + 0.02 * np.sin(8 * rest[:, ::-1])
    camera = orbit_view(1.2 * rest, width=WIDTH, height=HEIGHT)
    renderer = Renderer(camera)
    cases: dict[str, Callable[[], float]] = {}
    splats = {}
    for size in SIZES:
        carrier = GaussianCarrier(shell(size, rng), rest)
        splats[size], _ = carrier.at(moved)
        renderer.render(splats[size])
        cases[f"carry {size}"] = lambda carrier=carrier: spent_ms(lambda: carrier.at(moved))
        cases[f"render {size}"] = lambda size=size: spent_ms(lambda: renderer.render(splats[size]))
    ours = renderer.render(splats[PLAIN]).rgb
    difference = float(np.abs(plain(splats[PLAIN], camera) - ours).max())
    cases["plain"] = lambda: spent_ms(lambda: plain(splats[PLAIN], camera))
    canvas, inputs = renderer.prepared(splats[BY_PIXEL])
    ways = {name: name == "pixels" for name in ("pixels", "rows")}
    drawn = {name: blended(canvas, inputs, way)[0].numpy() for name, way in ways.items()}
    for name, way in ways.items():
        cases[name] = lambda way=way: spent_ms(lambda: blended(canvas, inputs, way))
    frames = [ours] * FILM_FRAMES
    cases["film"] = lambda: spent_ms(lambda: encode_mp4(frames, 30.0)) / FILM_FRAMES
    timings = interleave(cases, repeats)
    ms = {name: timing.median for name, timing in timings.items()}
    ratio = ms["plain"] / ms[f"render {PLAIN}"]
    return Report(
        name="video",
        title="Video",
        figures={
            "milliseconds_per_frame": ms,
            "plain_over_ours": ratio,
            "pixels_over_rows": ms["pixels"] / ms["rows"],
            "largest_difference_of_pixels_and_rows": float(np.abs(drawn["pixels"] - drawn["rows"]).max()),
            "largest_difference_to_plain": difference,
        },
        header=("Gaussians", "carry, ms", "render, ms", "plain numpy, ms"),
        rows=[
            (
                f"{size:,}",
                f"{ms[f'carry {size}']:.1f}",
                f"{ms[f'render {size}']:.0f}",
                f"{ms['plain']:.0f}" if size == PLAIN else "not run",
            )
            for size in SIZES
        ],
        notes=(
            f"Blending {BY_PIXEL:,} Gaussians takes {ms['rows']:.0f} ms by rows, {ms['pixels']:.0f} by pixels.",
            f"{WIDTH} x {HEIGHT} px, carried by {VERTICES} vertices; encoding H.264 takes {ms['film']:.0f} ms a frame.",
            f"The plain renderer takes {ratio:.1f} times as long; pictures differ by {difference:.1e} of full scale.",
        ),
        seed=seed,
    )


def spent_ms(work: Callable[[], object]) -> float:
    """CPU time of one call [ms]."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def ball(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points in a ball of 0.2 m."""
    direction = rng.normal(size=(count, 3))
    return (
        0.2 * rng.random((count, 1)) ** (1 / 3) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    )


def shell(count: int, rng: np.random.Generator) -> Gaussians:
    """Flat Gaussians on the ball's surface, as a trained splat has them; as many cover it once."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    wide = 1.5 * 0.2 * np.sqrt(4 * np.pi / count) / 2
    turns = np.concatenate(
        [1.0 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], np.zeros((count, 1))], axis=1
    )
    turns /= np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-9)
    scales = np.log(np.tile([wide, wide, 0.1 * wide], (count, 1)))
    return Gaussians(
        0.2 * normal, scales, turns, rng.normal(1.0, 1.0, count), rng.normal(0, 0.3, (count, 16, 3))
    )


def plain(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """A frame on white without tiles and kernel: Gaussians in the order of depth, each over the pixels in its reach."""
    renderer = Renderer(camera)
    local = gaussians.means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    centre, _ = camera.project(gaussians.means)
    colours = renderer._colours(gaussians, None)
    axes = rotation_matrices(gaussians.rotations) * np.exp(gaussians.log_scales)[:, None]
    left = np.ones((camera.height, camera.width))
    picture = np.zeros((camera.height, camera.width, 3))
    done = np.zeros(left.shape, dtype=bool)
    for g in np.argsort(local[:, 2]):
        x, y, z = local[g]
        jacobian = np.array(
            [[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]]
        )
        spread = jacobian @ camera.world_to_camera[:3, :3] @ axes[g]
        covariance = spread @ spread.T + 0.3 * np.eye(2)
        inverse = np.linalg.inv(covariance)
        reach = 3.0 * np.sqrt(np.linalg.eigvalsh(covariance)[1]) + 16
        low = np.maximum(np.floor(centre[g] - reach), 0).astype(int)
        high = np.minimum(np.ceil(centre[g] + reach), [camera.width, camera.height]).astype(int)
        if (high <= low).any():
            continue
        area = (slice(low[1], high[1]), slice(low[0], high[0]))
        dx = np.arange(low[0], high[0]) + 0.5 - centre[g, 0]
        dy = (np.arange(low[1], high[1]) + 0.5 - centre[g, 1])[:, None]
        square = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        alpha = np.minimum(0.99, gaussians.opacities[g] * np.exp(-0.5 * square))
        alpha = np.where((alpha >= 1 / 255) & ~done[area], alpha, 0.0)
        done[area] |= left[area] * (1 - alpha) < 1e-4
        alpha = np.where(done[area], 0.0, alpha)
        picture[area] += (left[area] * alpha)[..., None] * colours[g]
        left[area] *= 1 - alpha
    return np.clip(picture + left[..., None], 0.0, 1.0)


if __name__ == "__main__":
    run_alone(measure)
