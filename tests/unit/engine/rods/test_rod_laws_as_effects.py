"""Effects on discrete rods are numbers of their law: what a strength adds is what the law with that number does."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from discrete import LAW, along, line, problem

from physworld.effects.registry import EFFECTS, effect

TWIN = SimpleNamespace(law=LAW, lattice=SimpleNamespace(dim=1, smooth=False, title="a chain"))
SAME = [
    ("internal_friction", {"moment_per_m": 2.0, "onset_per_m": 0.7},
     {"friction_per_m": 2.0, "friction_onset_per_m": 0.7}),
    ("air_drag_across", {"coefficient_per_m": 0.4}, {"drag_normal_per_m": 0.4}),
    ("viscosity_kelvin_voigt", {"relaxation_s": 0.03}, {"relaxation_s": 0.03}),
    ("viscoelastic_maxwell", {"share": 0.5, "relaxation_s": 0.3}, {"creep_ratio": 0.5, "creep_s": 0.3}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "strengths", "numbers"), SAME, ids=[name for name, _, _ in SAME])
def test_a_strength_is_a_number_of_the_law(
    name: str, strengths: dict[str, float], numbers: dict[str, float]
) -> None:
    rod = problem(line(6))
    changed = effect(name, **strengths).problem(rod, TWIN)
    assert changed.law == replace(LAW, **numbers)
    assert EFFECTS[name].why_not(TWIN) is None


def test_friction_holds_a_cantilever_where_it_was_bent() -> None:
    """A rod that is let go from a bend: with friction it stays bent, without it comes back (Dahl's law, slow limit)."""
    from discrete import still

    from physworld.engine.rods.discrete_rods import DiscreteRods

    lattice = line(12, 0.5)
    start = along(lattice)
    angle = 0.6 * lattice.distances / lattice.distances.max()
    lengths = np.diff(lattice.distances)
    steps = lengths[:, None] * np.stack([np.cos(angle[1:]), np.zeros(12), np.sin(angle[1:])], axis=1)
    bent = np.concatenate([start[:1], start[0] + np.cumsum(steps, axis=0)])
    left = {}
    for moment in (0.0, 50.0):
        law = replace(LAW, relaxation_s=0.05)
        rod = problem(lattice, law, frames=2, edges=(1,))
        rod = effect("internal_friction", moment_per_m=moment, onset_per_m=0.5).problem(rod, TWIN)
        held = still([0, 1], bent, 2)
        found = DiscreteRods([rod]).run(bent, np.zeros_like(bent), [held], np.array([0.0, 10.0]))[0]
        left[moment] = float(found[-1, -1, 2] - bent[0, 2])
    height = float(bent[-1, 2] - bent[0, 2])
    assert abs(left[0.0]) < 0.5 * height < left[50.0]
