"""Our sheet beside MuJoCo flex, whose edges bend like hinges: how it stores bending, and how it moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers.flex_sheet import FlexSheet, bending_stiffnesses, record
from physworld.materials.sheet import SheetLaw
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

HINGED = FlexSheet(subdivision=2, frames=16, noise_sigma_m=0.0, seed=1)


def test_hinges_bend_less_than_a_plate_and_twist_three_times_as_stiffly() -> None:
    coarse, fine = bending_stiffnesses(FlexSheet()), bending_stiffnesses(FlexSheet(subdivision=3))
    for found in (coarse, fine):
        assert found["warp"] == pytest.approx(0.78, abs=0.05)
        assert found["weft"] == pytest.approx(0.85, abs=0.05)
        assert found["twist"] == pytest.approx(2.92, abs=0.01)


def test_a_sheet_with_that_twist_follows_the_hinged_one() -> None:
    scene = record(HINGED)
    membrane = HINGED.young_pa * HINGED.thickness_m / (1.0 - HINGED.poisson**2)
    plate = SheetLaw(
        membrane, membrane * HINGED.thickness_m**2 / 12.0, HINGED.poisson,
        density_kg_m2=HINGED.density_kg_m3 * HINGED.thickness_m,
    )  # fmt: skip
    hinges = bending_stiffnesses(HINGED)
    bends = 0.5 * (hinges["warp"] + hinges["weft"])
    like_it = replace(
        plate, bending_n_m=bends * plate.bending_n_m, bending_twist_ratio=hinges["twist"] / bends
    )
    twin = build_twin(scene)

    def missed(changed: Twin) -> float:
        nodes = changed.simulate_nodes(*scene.control_track(), scene.times)
        return float(np.sqrt(np.mean((changed.observe(nodes, scene.times) - scene.points)[-5:] ** 2)))

    moved = float(np.sqrt(np.mean((scene.points - scene.points[0])[-5:] ** 2)))
    assert missed(replace(twin, law=like_it)) < 0.5 * missed(replace(twin, law=plate))
    assert missed(replace(twin, law=like_it)) < 0.07 * moved
