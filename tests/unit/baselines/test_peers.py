"""Peers find what made a recording, predict another one of the object, and refuse what they have no word for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.arrays import Array
from physworld.baselines import PEERS, elastic_rod, linear_cloth, rigid_links
from physworld.baselines.fitting import least_squares
from physworld.errors import CalibrationError, SceneUnsupported
from physworld.scene import Body, Scene
from tests.tiny_scene import tiny_scene

GRAVITY = np.array([0.0, 0.0, -9.81])


def scene(kind: str, start: Array, controllers: Array, fps: float, body: Body) -> Scene:
    """A recording whose points are still to come."""
    frames = len(controllers)
    return Scene(
        name=kind,
        kind=kind,
        points=np.repeat(start[None], frames, axis=0),
        visible=np.ones((frames, len(start)), dtype=bool),
        controllers=controllers,
        times=np.arange(frames) / fps,
        gravity_m_s2=GRAVITY,
        noise_sigma_m=None,
        train=(0, round(0.7 * frames)),
        test=(round(0.7 * frames), frames),
        fps=fps,
        body=body,
    )


def rope(frames: int = 60) -> Scene:
    """A hanging rope of nine points whose ends are held by two points each, one pair shaken."""
    angle = np.linspace(-1.0, 1.0, 9)
    start = np.stack([0.5 * np.sin(angle), np.zeros(9), -0.5 * np.cos(angle)], axis=1)
    shake = 0.08 * np.sin(2 * np.pi * 1.5 * np.arange(frames) / 60.0)
    held = np.repeat(start[None, [0, 1, 7, 8]], frames, axis=0)
    held[:, :2, 2] += shake[:, None]
    return scene("rope", start, held, 60.0, Body())


def rod(frames: int = 40) -> Scene:
    """A rod that leaves its grip level and sags, three points along it, shaken sideways."""
    start = np.array([[0.0, 0, 0], [0.5, 0, -0.05], [0.95, 0, -0.3]])
    grip = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.0, 0.05, 0]])
    held = np.repeat(grip[None], frames, axis=0)
    held[:, :, 1] += 0.05 * np.sin(2 * np.pi * np.arange(frames) / 50.0)[:, None]
    return scene("rod", start, held, 50.0, Body(length_m=1.0))


def cloth(frames: int = 60) -> Scene:
    """A hanging sheet of 5 x 4 points, held at its upper corners, swung across itself."""
    i, j = np.meshgrid(np.arange(5), np.arange(4), indexing="ij")
    start = np.stack([0.06 * i, np.zeros_like(i), -0.06 * j], axis=-1).reshape(-1, 3).astype(float)
    held = np.repeat(start[None, [0, 16]], frames, axis=0)
    held[:, :, 1] += 0.05 * np.sin(2 * np.pi * np.arange(frames) / 30.0)[:, None]
    return scene("sheet", start, held, 20.0, Body(grid_shape=(5, 4)))


@pytest.mark.slow
def test_the_rod_predicts_what_another_rod_of_its_form_did() -> None:
    truth = np.log([[0.05, 0.002, 0.4, 0.03]])
    made = rope()
    made = replace(made, points=elastic_rod.simulate(made, truth, made.frame_count)[0])
    predicted = PEERS["elastic_rod"](made)(made)
    moved = np.linalg.norm(made.points - made.points[0], axis=-1)[42:].mean()
    assert np.linalg.norm(predicted - made.points, axis=-1)[42:].mean() < 0.02 * moved


@pytest.mark.slow
def test_the_links_predict_what_other_links_did(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rigid_links, "LINKS", 4)
    made = rod(30)
    size = 9.81
    truth = np.concatenate([np.log([[0.2 * size, 0.01 * size, 0.3]]), [[0.1, -0.05, 0.02]]], axis=1)
    made = replace(made, points=rigid_links.simulate(made, truth, made.frame_count)[0])
    predicted = PEERS["rigid_links"](made)(made)
    moved = np.linalg.norm(made.points - made.points[0], axis=-1)[21:].mean()
    assert np.linalg.norm(predicted - made.points, axis=-1)[21:].mean() < 0.05 * moved


def test_the_cloth_predicts_what_another_cloth_of_its_form_did() -> None:
    made = cloth()
    truth = np.log([[40.0, 8.0, 20.0, 0.5, 0.2, 0.4, 0.6]])
    made = replace(made, points=linear_cloth.simulate(made, truth, made.frame_count)[0])
    predicted = PEERS["linear_cloth"](made)(made)
    moved = np.linalg.norm(made.points - made.points[0], axis=-1)[42:].mean()
    assert np.linalg.norm(predicted - made.points, axis=-1)[42:].mean() < 0.01 * moved


def test_a_node_of_the_cloth_answers_as_an_oscillator() -> None:
    """Under two nodes that are shaken steadily, two others: the closed-form gain through one spring."""
    k, frames, hertz = 60.0, 400, 0.5
    times = np.arange(frames) / 50.0
    theta = np.log([[k, k, k, 1e-9, 1e-9, 1e-9, 4.0]])
    four = np.array([[0.0, 0, 0], [0.0, 0, -0.1], [0.1, 0, 0], [0.1, 0, -0.1]])
    both = np.repeat(four[None, [0, 2]], frames, axis=0)
    both[:, :, 1] += 0.1 * np.sin(2 * np.pi * hertz * times)[:, None]
    square = scene("sheet", four, both, 50.0, Body(grid_shape=(2, 2)))
    low = linear_cloth.simulate(square, theta, frames)[0, :, 1, 1]
    omega = 2 * np.pi * hertz
    gain = k / np.hypot(k - omega**2, 4.0 * omega)
    assert np.abs(low[200:]).max() == pytest.approx(0.1 * gain, rel=0.01)


def test_what_a_peer_has_no_word_for_is_refused() -> None:
    for name in ("elastic_rod", "rigid_links", "linear_cloth"):  # springs know any body: test_springs.py
        with pytest.raises(SceneUnsupported):
            PEERS[name](tiny_scene())
    with pytest.raises(SceneUnsupported, match="follow each other"):
        PEERS["elastic_rod"](replace(rope(), body=Body(edges=np.array([[0, k] for k in range(1, 9)]))))
    with pytest.raises(SceneUnsupported, match="length"):
        PEERS["rigid_links"](replace(rod(), body=Body()))


def test_least_squares_stays_within_its_bounds_and_says_when_no_start_runs() -> None:
    def residuals(theta: Array) -> Array:
        return np.asarray(np.stack([theta[:, 0] - 3.0, theta[:, 0] * theta[:, 1] - 6.0], axis=1))

    box = (np.array([0.0, 0.0]), np.array([5.0, 5.0]))
    assert least_squares(residuals, np.ones((1, 2)), *box) == pytest.approx([3.0, 2.0], abs=1e-3)
    assert least_squares(residuals, np.ones((1, 2)), np.zeros(2), np.array([2.0, 5.0]))[0] <= 2.0
    with pytest.raises(CalibrationError, match="none of 1 starts"):
        least_squares(lambda theta: np.full((len(theta), 2), np.nan), np.ones((1, 2)), *box)
