"""A live session without its connection."""

from __future__ import annotations

import numpy as np
import pytest
from published_tiny import tiny_model

from physworld.worldmodel.published import PublishedModel
from physworld_services.inference.session import HEAD, SET_BACK, LiveSession

pytestmark = pytest.mark.slow


def flags(frame: bytes) -> int:
    return int(HEAD.unpack_from(frame)[3])


def test_a_client_learns_that_it_was_set_back_whichever_frames_are_left_out() -> None:
    """Frames that a slow reader never gets told nobody: the flag stays until one was sent."""
    model = tiny_model()[2]
    tensors = model.to_tensors()
    tensors["prior.weight"] = 50.0 * tensors["prior.weight"]  # grows without bound
    session = LiveSession(PublishedModel.from_tensors(tensors, model.facts()))
    still, ticks = np.zeros((4, 3)), 0
    while not flags(session.frame(1.0, 0)) & SET_BACK:
        session.tick(still)
        ticks += 1
        assert ticks < 100, "the prediction stays in the numbers"
    session.tick(still)
    later = session.frame(1.0, 0)
    assert flags(later) & SET_BACK
    session.sent(later)
    session.tick(still)
    assert not flags(session.frame(1.0, 0)) & SET_BACK


def test_a_frame_between_two_ticks_is_of_one_moment() -> None:
    """Time, points and grips alike: grips that were ahead of the body would seem to stretch it."""
    session = LiveSession(tiny_model()[2])
    session.tick(np.tile([0.0, 0.0, 0.3], (4, 1)))
    first = session.frame(1.0, 0)
    session.tick(np.tile([0.0, 0.0, 0.3], (4, 1)))
    between, newest = session.frame(0.5, 0), session.frame(1.0, 0)
    heads = [HEAD.unpack_from(frame) for frame in (first, between, newest)]
    assert [head[0] for head in heads] == [1, 2, 2]
    assert [head[2] for head in heads] == pytest.approx([session.dt_s * tick for tick in (1.0, 1.5, 2.0)])
    places = [np.frombuffer(frame, "<f4", offset=HEAD.size) for frame in (first, between, newest)]
    assert places[1] == pytest.approx(0.5 * (places[0] + places[2]), abs=1e-7)
    assert places[2][-1] - places[0][-1] == pytest.approx(0.3 * session.dt_s, abs=1e-6)
