"""Springs step as their closed forms say, gradients are those of differences, and fits find what made a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.arrays import Array
from physworld.baselines import fit_phystwin, fit_spring_gaus, phystwin
from physworld.baselines.phystwin import Number
from physworld.baselines.spring_body import SpringBody, spring_body, springs_between
from physworld.baselines.spring_fit import Fitting, SpringModel, SpringSettings, network
from physworld.baselines.spring_steps import SHORTEST_S, Gradient, Run, Springs
from physworld.errors import SceneUnsupported, SimulationError
from physworld.scene import DeclaredCollider, Scene
from tests.tiny_scene import tiny_scene

pytestmark = pytest.mark.slow

SMALL = SpringSettings(points=60, population=6, generations=6, epochs=6)


def body(
    points: Array, velocity: Array | None = None, held: tuple[int, ...] = (), **given: object
) -> SpringBody:
    """Mass points that are tracked themselves, without gravity; the held ones stay where they are."""
    count = len(points)
    fields = {
        "origin": np.zeros(3),
        "points": points,
        "velocity": np.zeros((count, 3)) if velocity is None else velocity,
        "spacing": 1.0,
        "held": np.array(held, dtype=int),
        "knots": np.array([0.0, 100.0]),
        "paths": np.repeat(points[None, list(held)], 2, axis=0),
        "carriers": np.arange(count)[:, None],
        "shares": np.ones((count, 1)),
        "offsets": np.zeros((count, 3)),
        "gravity": np.zeros(3),
        "ground": None,
        "touches_itself": False,
        "start_s": 0.0,
    }
    return SpringBody(**(fields | given))  # type: ignore[arg-type]


def springs(
    pairs: Array,
    rest: Array,
    stiffness: float,
    damping: float,
    drag: float,
    collision: tuple[float, ...] = (0.0,) * 5,
) -> Springs:
    count = len(pairs)
    small = 1e-9
    return Springs(
        np.asarray(pairs), np.asarray(rest, dtype=float), np.full(count, np.log(stiffness)),
        np.full(count, np.log(max(damping, small))), float(np.log(max(drag, small))), np.array(collision),
    )  # fmt: skip


def cube() -> Array:
    return np.stack(np.meshgrid(*[np.arange(3) * 0.1] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(("damping", "drag"), [(0.0, 0.0), (1.5, 0.0), (0.0, 1.5), (0.7, 0.8)])
def test_one_spring_swings_as_its_closed_form(damping: float, drag: float) -> None:
    stiffness, rest, stretch = 40.0, 0.4, 0.05
    own = body(np.array([[0.0, 0.0, 0.0], [rest + stretch, 0.0, 0.0]]), held=(0,))
    times = np.linspace(0.0, 1.0, 41)
    run = Run(own, springs([[0, 1]], [rest], stiffness, damping, drag), 0.1)
    found = run.simulate(times)[:, 1, 0] - rest
    decay = 0.5 * (damping + drag)
    omega = np.sqrt(stiffness / rest - decay**2)
    closed = (
        stretch * np.exp(-decay * times) * (np.cos(omega * times) + decay / omega * np.sin(omega * times))
    )
    assert np.abs(found - closed).max() < 0.015 * stretch


def test_springs_among_themselves_keep_the_momentum() -> None:
    points = cube()
    rng = np.random.default_rng(0)
    velocity = rng.normal(0.0, 0.3, points.shape)
    pairs = springs_between(points, 0.18, 12)
    rest = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    tracks = Run(body(points, velocity), springs(pairs, rest, 20.0, 0.5, 0.0), 0.1).simulate(
        np.array([0.0, 0.5])
    )
    drifted = tracks[1].mean(axis=0) - points.mean(axis=0)
    assert np.abs(tracks[1] - points).max() > 0.05
    np.testing.assert_allclose(drifted, 0.5 * velocity.mean(axis=0), atol=2e-5)


def test_gradients_are_those_of_differences() -> None:
    points = cube()
    pairs = springs_between(points, 0.18, 12)
    rest = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    own = body(points, held=(0, 1, 2, 3, 4, 5, 6, 7, 8), gravity=np.array([0.0, 0.0, -9.81]))
    net = springs(pairs, rest, 30.0, 0.6, 0.4)
    times = np.array([0.0, 0.0512, 0.1])

    def loss(changed: Springs) -> float:
        return float(0.5 * np.sum((Run(own, changed, 0.1).simulate(times)[1:] - points) ** 2))

    def of_tracks(frames: Array, tracks: Array) -> Array:
        return np.where((frames > 0)[:, None, None], tracks - points, 0.0)

    slope = Run(own, net, 0.1, gradient=True).descend(times, of_tracks)[1]
    rng = np.random.default_rng(1)
    small = 0.05
    for name in ("stiffness", "damping"):
        way = rng.normal(size=len(pairs))
        sides = [
            loss(replace(net, **{name: getattr(net, name) + sign * small * way})) for sign in (1.0, -1.0)
        ]
        difference = (sides[0] - sides[1]) / (2.0 * small)
        assert getattr(slope, name) @ way == pytest.approx(difference, rel=0.02)
    sides = [loss(replace(net, drag=net.drag + sign * small)) for sign in (1.0, -1.0)]
    assert slope.drag == pytest.approx((sides[0] - sides[1]) / (2.0 * small), rel=0.02)


def test_a_point_bounces_on_the_ground_and_is_stopped_along_it() -> None:
    elasticity, friction = 0.6, 0.3
    points = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])
    velocity = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    own = body(points, velocity, gravity=np.array([0.0, 0.0, -9.81]), ground=0.0)
    net = springs([[0, 1]], [0.1], 1.0, 0.0, 0.0, (elasticity, friction, 0.0, 0.0, 0.0))
    fall = np.sqrt(2.0 * 0.5 / 9.81)
    speed = 9.81 * fall
    times = np.array([0.0, fall + elasticity * speed / 9.81, fall + 1.5 * elasticity * speed / 9.81])
    tracks = Run(own, net, 0.05).simulate(times)
    assert tracks[1, 0, 2] == pytest.approx(elasticity**2 * 0.5, rel=0.03)
    left = max(0.0, 1.0 - friction * (1.0 + elasticity) * speed)
    assert (tracks[2, 0, 0] - tracks[1, 0, 0]) / (times[2] - times[1]) == pytest.approx(left, abs=0.03)


def test_points_of_a_body_that_touches_itself_meet_and_part() -> None:
    points = np.array([[-0.2, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    velocity = np.array([[0.5, 0, 0], [0.5, 0, 0], [-0.3, 0, 0], [-0.3, 0, 0]])
    net = springs([[0, 1], [2, 3]], [0.1, 0.1], 5.0, 2.0, 0.0, (0.0, 0.0, 0.5, 0.2, 0.05))
    times = np.linspace(0.0, 1.0, 21)
    through = Run(body(points, velocity), net, 0.1).simulate(times)
    kept = Run(body(points, velocity, touches_itself=True), net, 0.1).simulate(times)
    assert (through[:, 1, 0] > through[:, 2, 0]).any()
    assert (kept[:, 1, 0] < kept[:, 2, 0]).all()
    np.testing.assert_allclose(kept[-1].mean(axis=0), [0.1, 0.0, 0.0], atol=1e-3)  # the momentum of two pairs


def test_springs_that_need_shorter_steps_are_refused_with_the_numbers() -> None:
    own = body(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), held=(0,))
    with pytest.raises(SimulationError, match=f"{SHORTEST_S}"):
        Run(own, springs([[0, 1]], [0.1], 1e9, 0.0, 0.0), 0.1)
    with pytest.raises(SimulationError, match="no spring joins the 2 points"):
        Run(own, springs(np.empty((0, 2), dtype=int), np.empty(0), 1.0, 0.0, 0.0), 0.1)


def test_tracked_points_go_with_any_affine_motion() -> None:
    scene = tiny_scene()
    own = spring_body(scene, 60)
    np.testing.assert_allclose(own.tracked(own.points[None])[0], scene.points[0], atol=1e-9)
    bent = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 1.0]])
    moved = own.tracked((own.points @ bent.T + [0.1, 0.2, 0.3])[None])[0]
    expected = (scene.points[0] - own.origin) @ bent.T + own.origin + [0.1, 0.2, 0.3]
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    gradient = np.random.default_rng(0).normal(size=(1, *scene.points[0].shape))
    step = np.random.default_rng(1).normal(size=own.points.shape)
    gained = own.tracked((own.points + step)[None]) - own.tracked(own.points[None])
    assert np.sum(gained * gradient) == pytest.approx(np.sum(own.pulled_back(gradient)[0] * step))


def made(stiffness: float) -> Scene:
    """The tiny bar as a network of one stiffness moves, dropped from level: three quarters of a second."""
    scene = tiny_scene(24)
    own = spring_body(scene, SMALL.points)
    even = network(own, 2.0, 24)
    net = replace(
        even,
        stiffness=even.stiffness + np.log(stiffness),
        damping=even.damping + np.log(2.0),
        drag=np.log(0.3),
    )
    return replace(scene, points=Run(own, net, SMALL.window_s).simulate(scene.times))


@pytest.mark.slow
def test_the_twin_finds_the_stiffness_that_made_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = made(2e3)
    fixed = {
        "damping": Number(1.99, 2.01), "drag": Number(0.299, 0.301), "reach": Number(1.9999, 2.0001, False),
        "most": Number(24, 24.2, False),
    }  # fmt: skip
    monkeypatch.setattr(phystwin, "NUMBERS", {"stiffness": Number(1e2, 1e5)} | fixed)
    model = fit_phystwin(scene, SMALL)
    assert float(np.exp(np.median(model.springs.stiffness))) == pytest.approx(2e3, rel=0.1)
    window = slice(*scene.test)
    moved = np.linalg.norm(scene.points - scene.points[0], axis=-1)[window].mean()
    assert np.linalg.norm(model(scene) - scene.points, axis=-1)[window].mean() < 0.05 * moved


@pytest.mark.slow
def test_all_numbers_are_searched_and_springs_are_then_told_apart() -> None:
    scene = made(2e3)
    model = fit_phystwin(scene, SMALL)
    assert model.loss_m <= model.started_m and model.simulations > SMALL.population * SMALL.generations
    assert np.ptp(model.springs.stiffness) > 0.0
    window = slice(*scene.test)
    moved = np.linalg.norm(scene.points - scene.points[0], axis=-1)[window].mean()
    assert np.linalg.norm(model(scene) - scene.points, axis=-1)[window].mean() < 0.3 * moved
    kept = SpringModel.from_arrays(model.to_arrays())
    np.testing.assert_array_equal(kept(scene), model(scene))
    finer = replace(kept, settings=replace(kept.settings, points=200))
    assert finer(scene).shape == scene.points.shape  # another count of points: joined anew


@pytest.mark.slow
def test_stiffness_of_every_point_is_learned_from_the_best_decade() -> None:
    scene = made(2e3)
    model = fit_spring_gaus(scene, replace(SMALL, epochs=12))
    assert model.loss_m < model.started_m
    assert np.ptp(model.springs.stiffness) > 0.0 and np.ptp(model.springs.damping) > 0.0
    window = slice(*scene.test)
    moved = np.linalg.norm(scene.points - scene.points[0], axis=-1)[window].mean()
    assert np.linalg.norm(model(scene) - scene.points, axis=-1)[window].mean() < 0.3 * moved


def test_held_out_frames_are_not_looked_at() -> None:
    scene = made(2e3)
    points = scene.points.copy()
    points[scene.test[0] :] += 1.0
    few = replace(SMALL, epochs=1)
    one, other = (fit_spring_gaus(of, few) for of in (scene, replace(scene, points=points)))
    assert one.loss_m == other.loss_m
    np.testing.assert_array_equal(one.springs.stiffness, other.springs.stiffness)


def test_what_they_have_no_word_for_is_refused() -> None:
    scene = tiny_scene()
    with pytest.raises(SceneUnsupported, match="training frames begin at 2"):
        Fitting(replace(scene, train=(2, 8)), SMALL)
    with pytest.raises(SceneUnsupported, match="1 rigid bodies push it"):
        fit_spring_gaus(replace(scene, colliders=(DeclaredCollider("peg", "sphere", radius_m=0.1),)), SMALL)
    hidden = scene.visible.copy()
    hidden[1 : scene.train[1]] = False
    with pytest.raises(SceneUnsupported, match="no point is seen"):
        Fitting(replace(scene, visible=hidden), SMALL)


def test_a_descent_ends_where_it_erred_least() -> None:
    scene = made(2e3)
    fitting = Fitting(scene, replace(SMALL, epochs=3))
    even = replace(network(fitting.body, 2.0, 24), drag=float(np.log(0.3)))
    even = replace(even, stiffness=even.stiffness + np.log(1e3), damping=even.damping + np.log(2.0))

    def uphill(slope: Gradient) -> Array:
        return -slope.stiffness

    theta, loss = fitting.descended(even.stiffness, lambda s: replace(even, stiffness=s), uphill)
    np.testing.assert_array_equal(theta, even.stiffness)
    assert loss == pytest.approx(fitting.loss(even))
