"""Bodies that Kratos records fall as closed forms say, swing at Euler's frequency, and follow their hands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers.finite_elements import Acting
from benchmarks.trace.hidden_kratos import KRATOS, Lump, Slab, Strand

pytest.importorskip("KratosMultiphysics", reason="Kratos comes with the extra bench")
from benchmarks.peers.kratos_bodies import Mesh, block, plate, rod

YOUNG_PA, DENSITY = 1e6, 900.0
DRAG_PER_S = 5.0
STILL = (np.eye(3), np.zeros(3))
MESHES = {
    "rod": rod(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.4, 0.006, YOUNG_PA, 0.4, DENSITY, 10),
    "plate": plate(np.zeros(3), 0.2, 0.2, (3, 3), 0.01, 2e5, 0.3, 350.0),
    "block": block(lambda unit: unit * [0.2, 0.1, 0.09], (3, 2, 2), 5e4, 0.35, 540.0),
}
SMALL: dict[str, Strand | Slab | Lump] = {
    "taut rope": KRATOS["taut rope"],
    "thick rope": replace(KRATOS["thick rope"], counts=(12, 2, 2)),
    "lump": replace(KRATOS["lump"], counts=(6, 3, 3)),
    "hung slab": replace(KRATOS["hung slab"], cells=(5, 5)),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_a_free_body_falls_through_a_drag(mesh: Mesh) -> None:
    times = np.arange(4) / 30.0
    went = mesh.record(Acting(linear_drag_per_s=DRAG_PER_S), [], times)[-1] - mesh.nodes
    fall = 9.81 / DRAG_PER_S * (times[-1] - (1.0 - np.exp(-DRAG_PER_S * times[-1])) / DRAG_PER_S)
    assert went[:, 2] == pytest.approx(-fall, rel=2e-3)
    assert np.abs(went[:, :2]).max() < 1e-6


def test_a_clamped_rod_swings_at_eulers_frequency() -> None:
    length, radius = 0.3, 0.01
    mesh = rod(np.zeros(3), np.array([1.0, 0.0, 0.0]), length, radius, YOUNG_PA, 0.4, DENSITY, 10)
    period = 2.0 * np.pi * length**2 / (3.5160 * np.sqrt(YOUNG_PA * radius**2 / (4.0 * DENSITY)))
    times = np.arange(0.0, 0.7 * period, period / 40.0)
    light = Acting(gravity_m_s2=np.array([0.0, 0.0, -0.05]))
    tip = mesh.record(light, [(np.array([0]), lambda _: STILL)], times)[:, -1, 2]
    low = int(np.argmin(tip))
    before, at, after = tip[low - 1 : low + 2]
    lowest = times[low] + 0.5 * (before - after) / (before - 2.0 * at + after) * times[1]
    assert 2.0 * lowest == pytest.approx(period, rel=0.02)


def test_what_it_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="gravity, linear drag and pushes"):
        MESHES["rod"].record(Acting(tether_n_m=1.0), [], np.arange(2) / 30.0)


@pytest.mark.parametrize("body", SMALL.values(), ids=SMALL)
def test_a_body_follows_its_hands_and_the_rest_falls(body: Strand | Slab | Lump) -> None:
    recorder = body.recorder(1, np.random.default_rng(0))
    times = np.arange(5) / 30.0
    tracks = recorder.tracks(Acting(), 0.0, times)
    for hand in recorder.hands:
        held = np.all((tracks[0] >= hand.box[0] + 1e-3) & (tracks[0] <= hand.box[1] - 1e-3), axis=1)
        turn, shift = hand.motion.place(0.0, times[-1])
        placed = (tracks[0, held] - hand.centre) @ turn.T + hand.centre + shift
        assert np.allclose(tracks[-1, held], placed, atol=1e-3)
    assert tracks[-1, :, 2].min() < tracks[0, :, 2].min() - 2e-3
    inside = recorder.inside(np.random.default_rng(0))
    assert np.all(np.ptp(inside, axis=0) <= np.ptp(tracks[0], axis=0) + 0.04)
