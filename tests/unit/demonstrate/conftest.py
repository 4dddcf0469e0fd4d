"""A soft block held at both ends, and its twin: small enough to be simulated in a blink."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LENGTH, SIDE = 0.2, 0.05
FPS = 30.0


def _held_block(frames: int = 60, *, moving: bool = True, ground: bool = False) -> Scene:
    """A block along x, three markers on a plate at each end; the right plate moves up and turns."""
    times = np.arange(frames) / FPS
    corners = np.array([[0.0, 0.0, 0.0], [0.0, SIDE, 0.0], [0.0, 0.0, SIDE]])
    first = np.concatenate([corners, corners + np.array([LENGTH, 0.0, 0.0])])
    controllers = np.repeat(first[None], frames, axis=0)
    if moving:
        shift = 0.03 * (1.0 - np.cos(2.0 * np.pi * 0.5 * times))
        controllers[:, 3:, 2] += shift[:, None]
    points = np.repeat(np.array([[[0.5 * LENGTH, 0.5 * SIDE, SIDE]]]), frames, axis=0)
    low, high = np.array([0.0, 0.0, 0.0]), np.array([LENGTH, SIDE, SIDE])
    return Scene(
        name="held_block",
        kind="block",
        points=points,
        visible=np.ones((frames, 1), dtype=bool),
        controllers=controllers,
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=1e-5,
        train=(0, int(0.7 * frames)),
        test=(int(0.7 * frames), frames),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(size_m=high - low, box_min_m=low, box_max_m=high, density_kg_m3=1000.0),
        ground=Ground(-0.02) if ground else None,
        grips=(
            Grip((0, 1, 2), low, np.array([0.02, SIDE, SIDE])),
            Grip((3, 4, 5), np.array([LENGTH - 0.02, 0.0, 0.0]), high),
        ),
    )


@pytest.fixture(scope="session")
def held_block() -> Callable[..., Scene]:
    """Makes held blocks: ``frames``, ``moving``, ``ground``."""
    return _held_block


@pytest.fixture(scope="session")
def block() -> Scene:
    """The held block."""
    return _held_block()


@pytest.fixture(scope="session")
def block_twin(block: Scene) -> Twin:
    """Its twin at a few hundred particles."""
    return build_twin(block, particle_budget=200)
