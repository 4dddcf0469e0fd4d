"""Which controllers move together, and control paths on the model's clock."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from held_bar import SMALL, lattice

from physworld.worldmodel.controls import grip_groups, on_clock, peak_speed
from physworld.worldmodel.errors import ControlsInvalid
from physworld.worldmodel.model.graph import build_graph

DT = 1 / 30


@pytest.mark.parametrize("most", [16, 4])
def test_controllers_that_are_gripped_together_move_together(most: int) -> None:
    rest = lattice()
    left, right = rest[rest[:, 0] < 0.01], rest[rest[:, 0] > 0.15]
    controllers = np.concatenate([left, right])[[0, 4, 1, 5, 2, 6, 3, 7]]
    groups = (np.array([0, 2, 4, 6]), np.array([1, 3, 5, 7]))
    config = dataclasses.replace(SMALL, control_vertices_all=most, control_vertices_per_grip=2)
    spec = build_graph(rest, rest, controllers, dt_s=DT, config=config, control_groups=groups)
    assert spec.control_count == (8 if most == 16 else 4)
    found = grip_groups(spec, controllers)
    assert [group.tolist() for group in found] == [group.tolist() for group in groups]


def test_paths_are_interpolated_to_the_clock_and_keep_their_ends() -> None:
    times = np.array([0.0, 0.05, 0.2])
    path = np.zeros((2, 3, 1, 3))
    path[:, :, 0, 0] = times
    ticks = on_clock(path, times, DT, 100)
    assert ticks.shape == (2, 7, 1, 3)
    assert ticks[0, :, 0, 0] == pytest.approx(np.arange(7) * DT)
    assert on_clock(path, None, DT, 100) is path
    assert peak_speed(ticks, DT) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (np.array([0.0, 0.1]), "2 times"),
        (np.array([0.1, 0.2, 0.3]), "start at 0"),
        (np.array([0.0, 0.2, 0.2]), "strictly"),
        (np.array([0.0, np.nan, 0.2]), "finite"),
        (np.array([0.0, 1.0, 100.0]), "100 s; 60 ticks of .* are the most for 1 candidates"),
    ],
)
def test_times_that_cannot_be_are_refused(times: np.ndarray, words: str) -> None:
    with pytest.raises(ControlsInvalid, match=words) as refused:
        on_clock(np.zeros((1, 3, 1, 3)), times, DT, 60)
    assert refused.value.field == "times"
