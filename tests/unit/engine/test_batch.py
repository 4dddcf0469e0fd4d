"""Episodes side by side run as they would alone, whatever becomes of their neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import FPS
from same_numbers import assert_same
from three_scenes import SCENES

from physworld.effects.registry import effect
from physworld.engine.total.batch import Batch
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import BatchRefused, CFLViolation, UnstableSimulation
from physworld.materials.library import with_law
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

FRAMES = 5
MOST = 1e-3  # [m] what must differ between episodes that are meant to differ


TWINS = {name: build_twin(make(FRAMES), 200) for name, make in SCENES.items()}
CHANGED = {
    "solid": {"youngs_modulus_pa": 3e4, "poissons_ratio": 0.2, "viscosity_pa_s": 4.0, "density_kg_m3": 300.0},
    "sheet": {"bending_n_m": 1e-4, "air_drag_per_s": 2.0, "density_kg_m2": 1.0},
    "rope": {"stretching_n": 20.0, "air_drag_per_s": 1.0},
}


def episode(twin: Twin, lift: tuple[float, float, float], frames: int = FRAMES, **options: object) -> Episode:
    """The grips go by ``lift`` [m] within ten frames."""
    times = np.arange(frames) / FPS
    shift = np.sin(0.5 * np.pi * times * FPS / 10)[:, None, None] ** 2 * np.array(lift)
    return Episode(times, twin.controllers_start + shift, times, **options)


def alone(twin: Twin, one: Episode, time_step_s: float | None = None) -> np.ndarray:
    """The episode's nodes as the engine integrates one body."""
    changed = twin.with_parameters(**one.parameters)
    run = changed.integration(
        one.control_times, one.control_points, one.frame_times,
        properties=one.properties, from_rest=one.from_rest,
    )  # fmt: skip
    engine = TotalLagrangian(run.problem, time_step_s)
    return run.at_frames(twin.body.start, engine.run(twin.body.start, run.velocity, run.held, run.knots))


def time_steps(twin: Twin, episodes: list[Episode]) -> np.ndarray:
    problems = [
        twin.with_parameters(**one.parameters)
        .integration(one.control_times, one.control_points, one.frame_times, properties=one.properties)
        .problem
        for one in episodes
    ]
    return Batch(problems).time_steps_s


@pytest.mark.parametrize("name", TWINS)
def test_episodes_side_by_side_are_those_that_run_alone(name: str) -> None:
    branch = {"shear_modulus_pa": 1e4} if name == "solid" else {"share": 0.3}
    twin = TWINS[name].with_effect(effect("gravity_tilt", tilt_x_rad=0.05))
    twin = twin.with_effect(effect("viscoelastic_maxwell", **branch))  # a term with memory
    fields = np.random.default_rng(0).normal(scale=0.3, size=(len(twin.particles_rest), 2))
    episodes = [
        episode(twin, (0.01, 0.05, 0.05)),
        episode(twin, (0.0, -0.05, 0.05), properties=fields),
        episode(twin, (0.03, 0.0, 0.02), parameters=CHANGED[name]),
    ]
    dt = float(time_steps(twin, episodes).min())
    outcomes = simulate_batch(twin, episodes)
    for one, outcome in zip(episodes, outcomes, strict=True):
        assert_same(outcome.trusted(), alone(twin, one, dt))
    ends = [outcome.trusted()[-1] for outcome in outcomes]
    assert min(np.abs(ends[0] - ends[1]).max(), np.abs(ends[0] - ends[2]).max()) > MOST


def test_a_batch_of_one_is_a_single_run() -> None:
    twin = TWINS["solid"]
    one = episode(twin, (0.0, 0.03, 0.03))
    (outcome,) = simulate_batch(twin, [one])
    assert_same(
        outcome.trusted(), twin.simulate_nodes(one.control_times, one.control_points, one.frame_times)
    )


def test_all_take_the_smallest_of_their_time_steps() -> None:
    twin = TWINS["solid"]
    stiff = episode(twin, (0.0, 0.0, 0.01), parameters={"youngs_modulus_pa": 4e5})
    rubbing = episode(twin, (0.0, 0.0, 0.01), parameters={"viscosity_pa_s": 50.0})
    episodes = [episode(twin, (0.0, 0.0, 0.01)), stiff, rubbing]
    steps = time_steps(twin, episodes)
    for one, step in zip(episodes, steps, strict=True):
        changed = twin.with_parameters(**one.parameters)
        run = changed.integration(one.control_times, one.control_points, one.frame_times)
        assert TotalLagrangian(run.problem).time_step_s == step
    assert steps[0] > 1.2 * steps[1] and steps[0] > 1.01 * steps[2]
    with pytest.raises(CFLViolation, match=f"of body {int(np.argmin(steps))} of 3"):
        simulate_batch(twin, episodes, time_step_s=float(steps[0]) / 0.6)


def test_an_episode_that_blows_up_has_its_error_and_spoils_no_neighbour() -> None:
    twin = TWINS["solid"]
    calm = [episode(twin, (0.0, 0.05, 0.05)), episode(twin, (0.05, 0.0, 0.0))]
    torn = episode(twin, (0.0, 0.0, 80.0))
    first, broken, last = simulate_batch(twin, [calm[0], torn, calm[1]])
    assert broken.nodes is None and isinstance(broken.error, UnstableSimulation)
    with pytest.raises(
        UnstableSimulation, match=r"blew up at t = \d\.\d+ s with time step .* cells inverted"
    ):
        broken.trusted()
    with pytest.raises(UnstableSimulation) as single:
        alone(twin, torn)
    assert str(broken.error) == str(single.value)
    for one, outcome in zip(calm, (first, last), strict=True):
        assert_same(outcome.trusted(), alone(twin, one))


def test_a_batch_that_is_lost_stops() -> None:
    twin = TWINS["solid"]
    frames: list[int] = []
    outcomes = simulate_batch(
        twin, [episode(twin, (0.0, 0.0, 2000.0))] * 2, progress=lambda done, total: frames.append(done)
    )
    assert all(outcome.error is not None for outcome in outcomes)
    assert max(frames) < FRAMES - 1


def test_an_episode_may_end_before_the_others() -> None:
    twin = TWINS["rope"]
    short, long = episode(twin, (0.0, 0.05, 0.05), frames=3), episode(twin, (0.0, 0.0, 0.08))
    ended, went_on = simulate_batch(twin, [short, long])
    assert len(ended.trusted()) == 3 and len(went_on.trusted()) == FRAMES
    np.testing.assert_array_equal(ended.trusted(), alone(twin, short))
    np.testing.assert_array_equal(went_on.trusted(), alone(twin, long))


def test_what_does_not_fit_side_by_side_is_refused() -> None:
    twin = TWINS["solid"]
    one = episode(twin, (0.0, 0.0, 0.01))
    late = replace(one, frame_times=1.1 * one.frame_times, control_times=1.1 * one.control_times)
    with pytest.raises(BatchRefused, match=r"body 1 of 2 stops at 0\.0366667 s"):
        simulate_batch(twin, [one, late])
    fibres = replace(twin, law=with_law(twin.law, "transversely_isotropic"))
    turned = replace(one, parameters={"fibre_azimuth_rad": 0.3})
    with pytest.raises(BatchRefused, match="share the numbers of their law"):
        simulate_batch(fibres, [one, turned])
    with pytest.raises(BatchRefused, match="one law; here are neo_hookean and transversely_isotropic"):
        Batch(
            [
                t.integration(one.control_times, one.control_points, one.frame_times).problem
                for t in (twin, fibres)
            ]
        )
    with pytest.raises(BatchRefused, match="updated Lagrangian"):
        simulate_batch(replace(twin, formulation="updated_lagrangian"), [one])
    with pytest.raises(BatchRefused, match="at least one"):
        simulate_batch(twin, [])


def test_whoever_watches_may_stop_all() -> None:
    class Stop(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise Stop

    twin = TWINS["rope"]
    with pytest.raises(Stop):
        simulate_batch(twin, [episode(twin, (0.0, 0.0, 0.01))] * 2, progress=stop)
