"""The share of stiffness that fades in every decade: which bodies may have it, and what it puts into a twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import box_body, made_scene

from physworld.calibrate.parameters import RELAXING_SHARE, relaxing
from physworld.effects.viscoelastic_maxwell import ViscoelasticMaxwell
from physworld.materials.plastic import VonMises
from physworld.scene import UNDEFORMED_AT_REST
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LOW, HIGH = np.array([-0.12, 0.0, 0.0]), np.array([0.0, 0.02, 0.02])
CLAMP = np.array([[-0.118, -0.01, 0.0], [-0.118, 0.03, 0.0], [-0.118, 0.03, 0.02]])
TIMES = np.arange(301) * 0.01  # three seconds at 100 Hz


def bar() -> Twin:
    scene = made_scene(
        [[x, 0.01, 0.02] for x in (-0.06, 0.0)],
        "beam",
        CLAMP,
        4,
        body=box_body(LOW, HIGH, density_kg_m3=1000.0),
        initial_state=UNDEFORMED_AT_REST,
    )
    return build_twin(scene, 100)


def test_a_branch_a_decade_from_half_a_frame_to_the_recording() -> None:
    (parameter,) = relaxing(bar(), TIMES)
    assert (parameter.name, parameter.stage, parameter.held) == (RELAXING_SHARE, "optional", 0.0)
    (added,) = parameter.apply(bar(), 0.04).effects
    assert isinstance(added, ViscoelasticMaxwell)
    assert (added.share, added.branches) == (0.04, 4)
    np.testing.assert_allclose(added.relaxation_s, 0.005)
    assert added.relaxation_s * 10.0 ** (added.branches - 1) >= TIMES[-1]


def test_a_body_that_flows_has_none() -> None:
    assert relaxing(replace(bar(), plasticity=VonMises(1e3)), TIMES) == []
