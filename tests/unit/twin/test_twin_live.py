"""A twin that is stepped by hand goes the way of the same twin under the finished track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene
from scipy.spatial.transform import Rotation
from tiny_scene import tiny_scene, tiny_thing

from physworld.effects.registry import effect
from physworld.errors import SceneUnsupported
from physworld.scene import Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.live import LiveTwin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

DT_S, TICKS = 1 / 60.0, 40
SHARE = 0.02
"""Of the motion: by how much a live run may differ, since a grip's next velocity is not known beforehand."""


def built(kind: str) -> tuple[Scene, Twin]:
    scene = tiny_scene() if kind == "beam" else tiny_thing(kind)
    twin = build_twin(scene, 60)
    return scene, twin.with_parameters(youngs_modulus_pa=3e4) if kind == "beam" else twin


@pytest.fixture(scope="module")
def measured_rope() -> Twin:
    """A discrete rod, held by a pose, that hangs from its grip above the ground."""
    points = np.stack([0.06 * np.arange(11), 0.01 * np.sin(np.arange(11)), np.full(11, 0.05)], axis=1)
    pose = points[0] + np.array([[0.0, 0.02, 0.0], [0.0, -0.02, 0.0], [0.01, 0.0, 0.02]])
    body = Body(segment_rest_lengths_m=np.full(10, 0.06), radius_m=0.005)
    return build_twin(made_scene(points, "rope", pose, 12, grips=(Grip((0, 1, 2)),), body=body))


def test_a_measured_rope_goes_the_way_of_the_finished_run_as_its_grip_turns(measured_rope: Twin) -> None:
    twin = measured_rope
    assert twin.formulation == "discrete_rod"
    times, points = track(twin)
    middle = points.mean(axis=1, keepdims=True)
    angles = np.linspace(0.0, 2.5, TICKS + 1)
    turned = [
        Rotation.from_rotvec([angle, 0.3 * angle, 0.0]).apply(p)
        for angle, p in zip(angles, points - middle, strict=True)
    ]
    points = middle + np.array(turned)
    live = LiveTwin(twin, DT_S)
    stepped = np.stack([live.particles, *(live.step(places) for places in points[1:])])
    whole = twin.simulate(times, points, times)
    size = np.abs(whole - whole[0]).max()
    assert size > 0.1
    assert np.abs(stepped - whole).max() < SHARE * size


def track(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """A grip that swings up and turns, (T,) and (T, K, 3)."""
    times = twin.release_s + DT_S * np.arange(TICKS + 1)
    phase = 2 * np.pi * 1.5 * (times - times[0])
    shift = 0.02 * np.stack([0.3 * np.sin(phase), 0.0 * phase, 1.0 - np.cos(phase)], axis=1)
    return times, twin.controllers_start[None] + shift[:, None]


def both(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """Particles of the live run and of the run under the finished track, (T, P, 3)."""
    times, points = track(twin)
    live = LiveTwin(twin, DT_S)
    stepped = np.stack([live.particles, *(live.step(places) for places in points[1:])])
    assert live.tick == TICKS and np.array_equal(live.controllers, points[-1])
    return stepped, twin.simulate(times, points, times)


@pytest.mark.parametrize("kind", ["beam", "sheet", "rope"])
def test_it_goes_the_way_of_the_run_under_the_finished_track(kind: str) -> None:
    stepped, whole = both(built(kind)[1])
    size = np.abs(whole - whole[0]).max()
    assert size > 0.01
    assert np.abs(stepped - whole).max() < SHARE * size


def test_effects_with_a_memory_keep_it_from_tick_to_tick() -> None:
    twin = built("beam")[1].with_effect(
        effect("viscoelastic_maxwell", shear_modulus_pa=2e4, relaxation_s=0.1)
    )
    stepped, whole = both(twin)
    size = np.abs(whole - whole[0]).max()
    assert np.abs(stepped - whole).max() < SHARE * size
    plain = both(replace(twin, effects=()))[0]
    assert np.abs(stepped - plain).max() > 2 * SHARE * size, "the memory makes no difference here"


def test_a_lag_of_the_grips_is_felt_live() -> None:
    stepped, whole = both(built("beam")[1].with_effect(effect("actuation_lag", lag_s=0.05)))
    assert np.abs(stepped - whole).max() < 2 * SHARE * np.abs(whole - whole[0]).max()


def test_a_first_interval_of_another_length_leads_to_the_models_clock() -> None:
    twin = built("beam")[1]
    times, points = track(twin)
    live = LiveTwin(twin, DT_S, lead_s=0.5 * DT_S)
    half = 0.5 * (points[0] + points[1])
    stepped = [live.step(half), live.step(points[1] + 0.5 * (points[2] - points[1]))]
    frames = times[0] + DT_S * np.array([0.0, 0.5, 1.5])
    whole = twin.simulate(frames, np.stack([points[0], half, 0.5 * (points[1] + points[2])]), frames)
    assert np.abs(np.stack(stepped) - whole[1:]).max() < 1e-4


@pytest.mark.parametrize("kind", ["beam", "rope"])
def test_a_run_that_is_carried_on_with_the_same_numbers_goes_the_same_way(kind: str) -> None:
    twin = built(kind)[1]
    if kind == "beam":
        twin = twin.with_effect(effect("viscoelastic_maxwell", shear_modulus_pa=2e4, relaxation_s=0.1))
    _, points = track(twin)
    plain, live = LiveTwin(twin, DT_S), LiveTwin(twin, DT_S)
    for tick, places in enumerate(points[1:]):
        if tick == TICKS // 2:
            live = live.changed(twin)
        ends = plain.step(places), live.step(places)
    assert live.tick == TICKS
    assert np.abs(ends[0] - ends[1]).max() < 1e-3 * np.abs(ends[0] - twin.particles_start).max()
    drag = effect("air_drag_linear", rate_per_s=20.0)
    assert np.abs(live.changed(twin.with_effect(drag)).step(points[-1]) - live.step(points[-1])).max() > 1e-6


def test_other_properties_change_the_motion() -> None:
    twin = built("beam")[1]
    _, points = track(twin)
    soft = LiveTwin(twin, DT_S, properties=np.full((len(twin.particles_rest), 2), [np.log(0.25), 0.0]))
    plain = LiveTwin(twin, DT_S)
    for places in points[1:]:
        ends = soft.step(places), plain.step(places)
    assert np.abs(ends[0] - ends[1]).max() > 2e-3


@pytest.mark.parametrize(
    ("name", "strength", "words"),
    [
        ("time_varying_stiffness", {"log_rate_per_s": 0.5}, "time since the start"),
        ("grip_slip", {"compliance_m_n": 1e-3}, "grip_slip pulls along the whole path"),
    ],
)
def test_what_needs_the_whole_track_is_refused_by_name(
    name: str, strength: dict[str, float], words: str
) -> None:
    with pytest.raises(SceneUnsupported, match=words):
        LiveTwin(built("beam")[1].with_effect(effect(name, **strength)), DT_S)
