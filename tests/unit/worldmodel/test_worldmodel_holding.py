"""World models by the grips that hold: what each learns from, rollouts in which grips let go and take hold again."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hanging_rope import graph as rope_graph
from hanging_rope import rest as rope_at_rest
from released_bar import BOTH, GRIPS, LEFT, SMALL, episodes, graph

from physworld.worldmodel.dataset import Track, read_track, split_tracks
from physworld.worldmodel.errors import ControlsInvalid, DatasetUnusable, GraphInvalid
from physworld.worldmodel.holding.rollout import HeldModels, HeldVersions
from physworld.worldmodel.holding.spans import (
    Span,
    held_tracks,
    look_ahead_for,
    spans_of,
    train_held,
)
from physworld.worldmodel.holding.taking import taken_hold, vertices_near
from physworld.worldmodel.live import LiveRollout
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.skinning import affine_skin
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.training import train
from physworld.worldmodel.training_run import open_loop_error

LEARNED, JUDGED, H = 18, 4, SMALL.history
PRIOR_ALONE = TrainingConfig(steps=1, batch_size=1, look_ahead=2, prior="modal")
PHI = np.zeros((36, 2))
ROUNDING_M = 1e-6  # single precision of arrays and engine


def every() -> list[dict[str, np.ndarray]]:
    return episodes(LEARNED + JUDGED)


def true_path(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Object vertices (T, n, 3)."""
    return arrays["particles"][:, graph().particle_index].astype(float)


def distances(path: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Mean error of each frame [m], (T,)."""
    return np.linalg.norm(path - true_path(arrays), axis=2).mean(axis=1)


def turn(angle: float) -> np.ndarray:
    """About an axis that is none of the coordinates'."""
    x, y, z = np.array([1.0, 2.0, 2.0]) / 3.0
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


@pytest.fixture(scope="module")
def models() -> HeldModels:
    specs = {BOTH: graph(BOTH), LEFT: graph(LEFT)}
    trained = train_held(every()[:LEARNED], specs, 2, SMALL, PRIOR_ALONE)
    return HeldModels({grips: result.model for grips, result in trained.items()}, GRIPS)


def test_a_graph_has_the_control_vertices_of_the_grips_that_hold() -> None:
    assert graph().control_index.tolist() == graph(BOTH).control_index.tolist() == list(range(8))
    left = graph(LEFT)
    assert left.control_index.tolist() == [0, 1, 2, 3]
    assert left.vertex_count == 40 and left.neighbours.max() == 40  # an empty slot
    assert np.array_equal(left.particle_index, graph().particle_index)
    for wrong in ((), (2,), (0, 0)):
        with pytest.raises(GraphInvalid, match="of the 2 that there are"):
            graph(wrong)


def test_spans_are_of_equal_rows_and_the_last_row_is_no_step() -> None:
    holding = np.array([[1, 1], [1, 1], [1, 0], [1, 0], [1, 1], [0, 1]])
    assert spans_of(holding) == [Span((0, 1), 0, 2), Span((0,), 2, 4), Span((0, 1), 4, 5)]
    assert spans_of(holding[:1]) == []


def test_a_set_learns_from_its_steps_alone_with_the_frames_before_them() -> None:
    arrays = every()[0]
    whole = read_track(graph(), arrays, H).positions
    spans = spans_of(arrays["holding"])
    assert [span.grips for span in spans] == [BOTH, LEFT, BOTH]
    taken = held_tracks(graph(BOTH), arrays, BOTH, 2, H)
    assert [len(track.positions) for track in taken] == [
        spans[0].end + 1,
        spans[2].end - spans[2].first + 1 + H,
    ]
    again = whole[spans[2].first - H : spans[2].end + 1]
    moved = again - taken[1].positions  # each track counts from an origin of its own
    assert torch.allclose(moved, moved[:1, :1].expand_as(moved), atol=ROUNDING_M)
    (alone,) = held_tracks(graph(LEFT), arrays, LEFT, 2, H)
    assert len(alone.positions) == spans[1].end - spans[1].first + 1 + H
    without = {name: array for name, array in arrays.items() if name != "holding"}
    (kept,) = held_tracks(graph(BOTH), without, BOTH, 2, H)
    assert torch.equal(kept.positions, whole)
    assert held_tracks(graph(LEFT), without, LEFT, 2, H) == []
    with pytest.raises(DatasetUnusable, match=r"60 frames says of \(60, 2\) which of 3 grips"):
        held_tracks(graph(LEFT), arrays, LEFT, 3, H)


def test_spans_shorter_than_a_step_with_its_history_are_left_out() -> None:
    arrays = dict(every()[0])
    holding = np.ones((60, 2), dtype=np.uint8)
    holding[:2, 1] = 0  # the frames 0 to 2: a history of two and no step
    arrays["holding"] = holding
    assert held_tracks(graph(LEFT), arrays, LEFT, 2, H) == []
    holding[:3, 1] = 0
    assert [len(track.positions) for track in held_tracks(graph(LEFT), arrays, LEFT, 2, H)] == [4]


def test_a_training_looks_no_further_ahead_than_most_spans_last() -> None:
    tracks = [Track(torch.zeros(frames, 3, 3), torch.zeros(3, 2)) for frames in (8, 12, 14, 40)]
    assert look_ahead_for(tracks, H, 24) == 12 - H - 1
    assert look_ahead_for(tracks, H, 4) == 4
    assert look_ahead_for(tracks[:1], H, 24) == 8 - H - 1


def test_episodes_without_the_set_are_passed_over_and_parts_of_one_stay_together() -> None:
    spans = [held_tracks(graph(BOTH), arrays, BOTH, 2, H) for arrays in every()[:3]]
    result = train([[], *spans, []], graph(BOTH), SMALL, PRIOR_ALONE)
    assert result.episodes == 3
    plain = train(spans, graph(BOTH), SMALL, PRIOR_ALONE)
    assert plain.prior_error_m == result.prior_error_m
    first = [read_track(graph(BOTH), arrays, H) for arrays in every()[:3]]
    alone = train([[track] for track in first], graph(BOTH), SMALL, PRIOR_ALONE)
    assert alone.prior_error_m == train(first, graph(BOTH), SMALL, PRIOR_ALONE).prior_error_m
    _, judged = split_tracks(spans[:2], PRIOR_ALONE.validation_fraction, PRIOR_ALONE.seed)
    two = train(spans[:2], graph(BOTH), SMALL, PRIOR_ALONE)
    assert len(judged[0]) == 2 and two.best_error_m == open_loop_error(two.model, judged[0])
    with pytest.raises(DatasetUnusable, match="first 2 of 2 episodes have no part"):
        train([[], []], graph(BOTH), SMALL, PRIOR_ALONE)
    with pytest.raises(DatasetUnusable, match=r"in none of 1 episodes the grips \[1\] of 2 hold"):
        train_held(every()[:1], {(1,): graph((1,))}, 2, SMALL, PRIOR_ALONE)


def test_models_that_hand_over_follow_a_grip_that_lets_go_and_takes_hold_again(models: HeldModels) -> None:
    """Against the model of all grips alone, and against following the first grip rigidly.

    What the open grip's material does is not told: its hand stays where it let go, and is back when it closes.
    """
    one, parts = models.members[BOTH], []
    for arrays in every()[LEARNED:]:
        true, controllers = true_path(arrays), arrays["controllers"].astype(float)
        _, opened, closed = spans_of(arrays["holding"])
        controllers[opened.first : closed.first, 4:] = controllers[opened.first, 4:]
        paths = (
            models.rollout(true[: H + 1], controllers, arrays["holding"], PHI),
            rollout(one, one.spec, true[: H + 1], controllers, PHI),
            true[0] + (controllers[:, :4].mean(axis=1) - controllers[0, :4].mean(axis=0))[:, None],
        )
        errors = [distances(path, arrays) for path in paths]
        open_, after = slice(opened.first, closed.first + 1), slice(closed.first + 1, None)
        parts.append([[error[part].mean() for error in errors] for part in (open_, after)])
    while_open, after_it = np.mean(parts, axis=0)
    assert while_open[0] < 0.4 * while_open[1:].min()
    assert after_it[0] < 0.9 * after_it[1]  # which is told where the hand has the material now
    assert after_it[0] < 0.25 * after_it[2]


def test_without_a_change_it_is_the_rollout_of_one_model(models: HeldModels) -> None:
    arrays = every()[LEARNED]
    start, controllers = true_path(arrays)[: H + 1], arrays["controllers"].astype(float)
    for grips, model in models.members.items():
        holding = np.tile(np.isin([0, 1], grips), (60, 1))
        path = models.rollout(start, controllers, holding, {grips: PHI})
        alone = rollout(model, model.spec, start, controllers, PHI)
        assert np.array_equal(path[: H + 1], start) and np.array_equal(path[H + 1 :], alone[H + 1 :])


def test_a_member_goes_on_from_the_last_frames_of_the_one_before(models: HeldModels) -> None:
    arrays = every()[LEARNED]
    start, controllers = true_path(arrays)[: H + 1], arrays["controllers"].astype(float)
    holding = np.ones((60, 2))
    holding[20:, 1] = 0
    path = models.rollout(start, controllers, holding, PHI)
    parts = [models.members[grips] for grips in (BOTH, LEFT)]
    first = rollout(parts[0], parts[0].spec, start, controllers[:21], PHI)
    second = rollout(parts[1], parts[1].spec, first[20 - H :], controllers[20 - H :], PHI)
    assert np.array_equal(path[H + 1 : 21], first[H + 1 :])
    assert np.allclose(path[21:], second[H + 1 :], atol=ROUNDING_M)


def test_material_where_the_hand_expects_it_is_held_as_the_hand_says(models: HeldModels) -> None:
    """Also with noise of the controllers, and about a rope, whose turn no vertex shows."""
    arrays = every()[LEARNED]
    path, hand = true_path(arrays), arrays["controllers"].astype(float)[:, 4:]
    _, opened, closed = spans_of(arrays["holding"])
    near = vertices_near(graph(), path[0], hand[0])
    assert sorted(graph().particle_index[near]) == [32, 33, 34, 35]
    hand[closed.first :] += 1e-4 * np.random.default_rng(0).normal(size=hand[closed.first :].shape)
    taken = taken_hold(path[: closed.first + 1, near], hand, opened.first)
    assert len(taken) == 60 - opened.first - 1
    bent = 1e-3  # of the held particles while they are free, and the noise of a fit to four controllers
    assert np.abs(taken - hand[opened.first + 1 :]).max() < bent
    after = closed.first - opened.first - 1
    steady = np.diff(taken[after:] - hand[closed.first :], axis=0)
    assert np.abs(steady).max() < 2e-5  # the noise is the hand's, each frame's own

    spec, line = rope_graph(), rope_at_rest()
    ends = vertices_near(spec, spec.rest_vertices, line[-1:])
    assert len(ends) == 2
    markers = line[-1] + np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.03]])
    turns = [turn(0.1 * k) for k in range(6)]
    carried = np.array([markers @ one.T + 0.01 * k for k, one in enumerate(turns)])
    rope = np.array([spec.rest_vertices[ends] @ one.T + 0.01 * k for k, one in enumerate(turns)])
    assert np.allclose(taken_hold(rope[:4], carried, 0)[2:], carried[3:], atol=1e-12)


def test_a_hand_that_closes_elsewhere_moves_what_is_there(models: HeldModels) -> None:
    """From closing on only the hand's motion counts: displaced and turned, it gives the same rollout."""
    arrays = every()[LEARNED + 1]
    start, controllers = true_path(arrays)[: H + 1], arrays["controllers"].astype(float)
    *_, closed = spans_of(arrays["holding"])
    off = controllers.copy()
    hand = controllers[closed.first :, 4:]
    centre = hand.mean(axis=1, keepdims=True)
    off[closed.first :, 4:] = (hand - centre) @ turn(0.4).T + centre + [0.01, -0.005, 0.02]
    holding = arrays["holding"]
    expected = models.rollout(start, controllers, holding, PHI)
    assert np.abs(models.rollout(start, off, holding, PHI) - expected).max() < ROUNDING_M
    believed = models.rollout(start, off, holding, PHI, take_hold=False)
    assert np.abs(believed - expected)[-1].max() > 5e-3


def test_what_a_rollout_cannot_follow_is_said(models: HeldModels) -> None:
    arrays = every()[LEARNED]
    start, controllers = true_path(arrays)[: H + 1], arrays["controllers"].astype(float)
    holding = np.array(arrays["holding"])

    def refused(kind: type[Exception], match: str, **changed: np.ndarray) -> None:
        given = {"history": start, "controllers": controllers, "holding": holding} | changed
        with pytest.raises(kind, match=match):
            models.rollout(given["history"], given["controllers"], given["holding"], PHI)

    right, none = holding.copy(), holding.copy()
    right[30:40], none[30:40] = (0, 1), 0
    refused(
        ControlsInvalid, r"grips \[1\] hold from frame 30 to 40; there are world models of", holding=right
    )
    refused(ControlsInvalid, "no grip holds from frame 30 to 40: .* at least one", holding=none)
    refused(ControlsInvalid, r"holding of shape \(59, 2\) for 60 frames of 2 grips", holding=holding[1:])
    refused(GraphInvalid, r"history of shape \(2, 36, 3\)", history=start[1:])
    refused(GraphInvalid, r"controllers of \(60, 7, 3\)", controllers=controllers[:, 1:])
    broken = start.copy()
    broken[1, 2, 0] = np.nan
    refused(GraphInvalid, "1 values of controllers and history", history=broken)
    lost = copy.deepcopy(models.members[LEFT])
    lost.prior.mean.fill_(float("inf"))
    closed = spans_of(holding)[-1].first
    unsteady = HeldModels({**models.members, LEFT: lost}, GRIPS)
    with pytest.raises(GraphInvalid, match=rf"left the numbers before frame {closed}, .* \[0, 1\] hold"):
        unsteady.rollout(start, controllers, holding, PHI)
    other = WorldModel(replace(SMALL, history=3), graph(LEFT))
    with pytest.raises(GraphInvalid, match=r"history 3, the first one .* and 2"):
        HeldModels({**models.members, LEFT: other}, GRIPS)
    with pytest.raises(GraphInvalid, match="has control vertices of others"):
        HeldModels({LEFT: models.members[BOTH]}, GRIPS)


def published_versions(models: HeldModels) -> list[PublishedModel]:
    """Of both grips and of the left one, as they are read back."""
    arrays = every()[LEARNED]
    true, controllers = true_path(arrays), arrays["controllers"].astype(float)
    versions = []
    for holding, grips in ((None, BOTH), (LEFT, LEFT)):
        version = PublishedModel(
            model=models.members[grips],
            phi=PHI,
            phi_calibrated=PHI,
            start_history=true[: H + 1],
            start_controllers=controllers[: H + 1],
            start_time_s=0.0,
            skin=affine_skin(true[0], true[0]),
            grips=tuple(tuple(group.tolist()) for group in GRIPS),
            holding=holding,
        )
        versions.append(PublishedModel.from_tensors(version.to_tensors(), version.facts()))
    return versions


def test_published_versions_roll_out_together(models: HeldModels) -> None:
    arrays = every()[LEARNED]
    true, controllers = true_path(arrays), arrays["controllers"].astype(float)
    versions = published_versions(models)
    assert [version.holding for version in versions] == [None, LEFT]
    together = HeldVersions.of(versions).rollout(controllers, arrays["holding"])
    expected = models.rollout(true[: H + 1], controllers, arrays["holding"], PHI)
    assert np.abs(together - expected).max() < ROUNDING_M
    with pytest.raises(GraphInvalid, match="2 versions are of 1 sets"):
        HeldVersions.of([versions[1], versions[1]])
    before = {name: fact for name, fact in versions[0].facts().items() if name not in {"grips", "holding"}}
    old = PublishedModel.from_tensors(versions[0].to_tensors(), before)
    assert (old.holding, old.grips) == (None, ())


def test_a_live_session_lets_go_and_takes_hold_as_a_rollout_does(models: HeldModels) -> None:
    """The hand stays where it let go; from closing on the material moves by the hand's motion."""
    versions = published_versions(models)
    whole = replace(versions[0], others=(versions[1],))
    hands, opened, closed = versions[0].start_controllers[-1], 9, 17
    moves = np.zeros((40, 8, 3))
    ticks = np.arange(40) - H
    moves[:, :4] = 0.01 * np.sin(0.3 * np.maximum(ticks, 0))[:, None, None]
    moves[:, 4:, 2] = (
        0.0015 * np.where(ticks < opened, ticks, np.maximum(ticks - closed, 0) + opened)[:, None]
    )
    moves[: H + 1] = 0.0
    controllers = hands + moves
    controllers[: H + 1] = versions[0].start_controllers
    holding = np.ones((40, 2), dtype=np.uint8)
    holding[H + opened : H + closed, 1] = 0
    expected = HeldVersions.of_one(whole).rollout(controllers, holding)

    session = LiveRollout(whole)
    assert session.sets == [LEFT, BOTH]
    for round_ in range(2):
        carried = []
        for tick in range(40 - H - 1):
            session.hold([g for g in BOTH if holding[H + tick, g]])
            places = session.controllers + np.diff(controllers, axis=0)[H + tick]
            session.step(places)
            carried.append(session.controllers[4:].mean(axis=0))
            assert np.abs(session.vertices - expected[H + tick + 1]).max() < ROUNDING_M, (round_, tick)
        fell = np.ptp(np.array(carried)[opened:closed, 2])
        assert fell > 3e-4, "the open grip does not go along with the material"
        with pytest.raises(GraphInvalid, match=r"grips \[1\] are to hold; .* \[0\], \[0, 1\]"):
            session.hold([1])
        assert session.holding == BOTH
        session.hold(LEFT)
        session.reset()
        assert session.holding == BOTH


def test_a_grip_that_is_open_at_the_start_closes_where_its_hand_is(models: HeldModels) -> None:
    """It stood to no material before: its path is taken as it is, whether material is to be taken hold of or not."""
    arrays = every()[-1]
    history, hands = true_path(arrays)[: H + 1], arrays["controllers"].astype(float)
    holding = arrays["holding"].copy()
    closes = int(np.flatnonzero(holding[:, 1] == 0)[-1]) + 1
    holding[:closes, 1] = 0
    taken, given = (models.rollout(history, hands, holding, PHI, take_hold=one) for one in (True, False))
    assert np.abs(taken - given).max() == 0.0
    usual, path = (
        models.rollout(history, hands, arrays["holding"], PHI, take_hold=one) for one in (True, False)
    )
    assert np.abs(usual - path).max() > 1e-5
