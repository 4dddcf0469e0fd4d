"""Splats: the PLY layout, what is refused, and how vertices carry them."""

from __future__ import annotations

import io
import tracemalloc

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from test_video_render import some

from physworld.errors import GaussiansUnreadable
from physworld.video import GaussianCarrier, Gaussians, from_ply, gaussians_at_points, to_ply
from physworld.video.render import rotation_matrices


@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_a_splat_is_written_and_read(harmonics: int) -> None:
    splat = some(7, harmonics)
    again = from_ply(to_ply(splat))
    for name in ("means", "log_scales", "rotations", "opacity_logits", "harmonics"):
        np.testing.assert_allclose(getattr(again, name), getattr(splat, name), rtol=1e-6, atol=1e-7)


def test_the_layout_is_the_reference_implementations() -> None:
    splat = some(3)
    vertex = PlyData.read(io.BytesIO(to_ply(splat)))["vertex"]
    assert {"x", "f_dc_2", "f_rest_44", "opacity", "scale_2", "rot_3"} <= {p.name for p in vertex.properties}
    assert vertex["f_rest_0"][1] == pytest.approx(splat.harmonics[1, 1, 0])  # all of red first,
    assert vertex["f_rest_15"][1] == pytest.approx(splat.harmonics[1, 1, 1])  # then green


def broken(**columns: np.ndarray) -> bytes:
    vertex = PlyData.read(io.BytesIO(to_ply(some(4, 1))))["vertex"].data.copy()
    for name, values in columns.items():
        vertex[name] = values
    buffer = io.BytesIO()
    PlyData([PlyElement.describe(vertex, "vertex")]).write(buffer)
    return buffer.getvalue()


def cloud() -> bytes:
    buffer = io.BytesIO()
    points = np.zeros(5, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(buffer)
    return buffer.getvalue()


ENORMOUS = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 900000000000\nproperty float x\nend_header\n"
)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "0 bytes"),
        (b"\x80\x04not a ply", "not a PLY"),
        (to_ply(some(9))[:-40], "not a PLY file of Gaussians"),
        (cloud(), "a point cloud, not a splat"),
        (broken(x=np.array([0, np.nan, 1, np.inf])), "2 of 4 Gaussians"),
        (broken(rot_0=0.0, rot_1=0.0, rot_2=0.0, rot_3=0.0), "4 rotations of length 0"),
        (broken(scale_0=50.0), "to 50"),
        (ENORMOUS, "PLY|900"),
    ],
)  # fmt: skip
def test_what_is_no_splat_is_refused_with_its_numbers(content: bytes, said: str) -> None:
    with pytest.raises(GaussiansUnreadable, match=said):
        from_ply(content)


def test_a_rigid_motion_of_the_vertices_is_one_of_the_splat() -> None:
    rng = np.random.default_rng(1)
    rest, splat = rng.uniform(-0.4, 0.4, (60, 3)), some(25)
    turn = np.array([0.5, 0.5, -0.1, 0.7])
    turn /= np.linalg.norm(turn)
    matrix, shift = rotation_matrices(turn[None])[0], np.array([0.3, -1.0, 2.0])
    moved, turned_by = GaussianCarrier(splat, rest).at(rest @ matrix.T + shift)
    np.testing.assert_allclose(moved.means, splat.means @ matrix.T + shift, atol=1e-9)
    np.testing.assert_allclose(rotation_matrices(turned_by), np.tile(matrix, (25, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(
        rotation_matrices(moved.rotations), matrix @ rotation_matrices(splat.rotations), atol=1e-9
    )


def test_a_bend_carries_the_means_along() -> None:
    x = np.linspace(0, 1, 41)
    rest = np.array([[a, b, c] for a in x for b in (-0.05, 0.05) for c in (-0.05, 0.05)])

    def bent(points: np.ndarray) -> np.ndarray:
        angle, radius = points[:, 0] / 2.0, 2.0 + points[:, 2]
        return np.stack([radius * np.sin(angle), points[:, 1], radius * np.cos(angle) - 2.0], axis=1)

    points = np.random.default_rng(2).uniform([0.1, -0.04, -0.04], [0.9, 0.04, 0.04], (50, 3))
    moved, _ = GaussianCarrier(gaussians_at_points(points), rest).at(bent(rest))
    assert np.linalg.norm(moved.means - bent(points), axis=1).max() < 2e-3
    assert np.linalg.norm(bent(points) - points, axis=1).max() > 0.1


def test_thousands_of_vertices_carry_a_splat_in_little_memory() -> None:
    """Every pair of them at once would take gigabytes, and anew for every frame."""
    rest = np.random.default_rng(3).uniform(-0.1, 0.1, (2500, 3))
    splat = gaussians_at_points(rest[:20])
    tracemalloc.start()
    carrier = GaussianCarrier(splat, rest)
    _, bound = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    moved, _ = carrier.at(rest + np.array([0.0, 0.0, 0.1]))
    _, carried = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(moved.means, splat.means + np.array([0.0, 0.0, 0.1]), atol=1e-12)
    assert bound < 100e6
    assert carried < 20e6


def test_a_splat_of_another_frame_and_wrong_vertices_are_refused() -> None:
    rest = np.random.default_rng(1).uniform(-0.1, 0.1, (30, 3))
    far = some(10)
    with pytest.raises(ValueError, match="another frame or unit"):
        GaussianCarrier(
            Gaussians(far.means + 40.0, far.log_scales, far.rotations, far.opacity_logits, far.harmonics),
            rest,
        )
    carrier = GaussianCarrier(far, rest)
    with pytest.raises(ValueError, match=r"shape \(30, 3\), got \(29, 3\)"):
        carrier.at(rest[1:])
    with pytest.raises(ValueError, match="finite"):
        carrier.at(np.full_like(rest, np.nan))
    with pytest.raises(GaussiansUnreadable, match=r"\(0, 3\)"):
        gaussians_at_points(np.zeros((0, 3)))
    assert len(gaussians_at_points(np.zeros((1, 3)))) == 1
