"""Live sessions from the SDK, over a real WebSocket."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from itertools import islice

import httpx
import numpy as np
import pytest
from inference_serving import Served, serve_inference
from physworld_client import (
    AsyncClient,
    Client,
    ConnectionFailed,
    LiveSessionEnded,
    NotFound,
    RequestTimedOut,
)
from physworld_client.live import LiveSession
from published_tiny import publish_tiny

from physworld_services.inference import live

UP, STILL = (0.0, 0.0, 0.1), (0.0, 0.0, 0.0)  # m/s


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        yield served


@pytest.fixture
def client(served: Served) -> Iterator[Client]:
    with Client(served.url, served.token) as client:
        yield client


def opened(session: AbstractContextManager[LiveSession]) -> None:
    with session:
        pass


def test_a_grip_that_is_steered_takes_the_points_along_and_reset_brings_them_back(
    served: Served, client: Client
) -> None:
    with client.live.open(served.model) as session:
        start = session.start
        assert start.grips == ((0, 1, 2, 3),)
        assert start.controllers.shape == (4, 3)
        number = 0
        while number < 25:
            frame, number = session.frame(), session.steer(UP)
        assert 0 < frame.control <= number
        assert frame.time_s == pytest.approx(frame.tick * start.dt_s, rel=1e-5)
        assert not frame.set_back
        lifted = frame.controllers[:, 2] - start.controllers[:, 2]
        assert lifted == pytest.approx(np.full(4, lifted[0]), abs=1e-5)
        assert lifted[0] > 0.03
        assert (frame.points - start.points)[:, 2].mean() > 0.5 * lifted[0]
        session.steer(STILL)
        session.reset()
        assert any(f.controllers == pytest.approx(start.controllers, abs=1e-6) for f in islice(session, 40))


def test_one_velocity_steers_all_grips_and_rows_steer_what_they_name(served: Served, client: Client) -> None:
    with client.live.open(served.model, 1, part="vertices") as session:
        assert session.start.points.shape == (20, 3)
        for rows in (UP, [UP], [UP] * 4):
            session.steer(np.array(rows))
        with pytest.raises(ValueError, match=r"shape \(2, 3\); a session of 1 grips and 4 control points"):
            session.steer(np.zeros((2, 3)))
        with pytest.raises(ValueError, match="1 velocities are no finite number"):
            session.steer([0.0, float("nan"), 0.0])
        assert session.frame().points.shape == (20, 3)


def test_a_body_gets_other_properties_and_a_property_that_is_not_there_ends_the_session(
    served: Served, client: Client
) -> None:
    def lifted(factors: dict[str, float]) -> np.ndarray:
        with client.live.open(served.model) as session:
            assert session.start.factors == ("stiffness", "density")
            session.set_factors(factors)
            session.reset()
            while session.frame().controllers[0, 2] - session.start.controllers[0, 2] < 0.02:
                session.steer(UP)
            return session.frame().points - session.start.points

    plain, stiff = lifted({}), lifted({"stiffness": 50.0})
    assert np.abs(stiff - plain).max() > 1e-4
    with pytest.raises(LiveSessionEnded, match="no property 'colour'"):
        lifted({"colour": 2.0})


def test_a_grip_is_opened_and_falls_with_the_material(served: Served, client: Client) -> None:
    bar = {"name": "tiny-between", "kind": "between two grips"}
    model, version = publish_tiny(served.database, served.stores.artifacts, **bar)
    with client.live.open(model, version) as session:
        start = session.start
        assert start.holding == ((0,), (0, 1))
        session.open_grips([1])
        for frame in session:
            if frame.controllers[4:, 2].mean() < start.controllers[4:, 2].mean() - 3e-3:
                break
        assert frame.controllers[:4] == pytest.approx(start.controllers[:4], abs=1e-6)
        session.open_grips([])
        closed = [frame.controllers for frame in islice(session, 40)]
        assert closed[-1] == pytest.approx(closed[-10], abs=1e-6)
    with client.live.open(model, version) as session, pytest.raises(LiveSessionEnded, match="would hold"):
        session.open_grips([0])
        for _ in range(200):
            session.frame()


def test_a_session_that_is_closed_says_so(served: Served, client: Client) -> None:
    with client.live.open(served.model) as session:
        pass
    with pytest.raises(LiveSessionEnded) as refused:
        session.steer(UP)
    assert refused.value.code == 1000


def test_what_cannot_be_opened_is_a_typed_error(
    served: Served, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(NotFound, match="nothing-of-that-name"):
        opened(client.live.open("nothing-of-that-name"))
    with pytest.raises(ValueError, match="frames is 9"):
        opened(client.live.open(served.model, frames=9))
    with ExitStack() as taken:
        for _ in range(live.MOST_SESSIONS):
            taken.enter_context(client.live.open(served.model))
        with pytest.raises(LiveSessionEnded, match=f"{live.MOST_SESSIONS} sessions are open") as refused:
            opened(client.live.open(served.model))
        assert refused.value.code == 1013
    old = {"name": "tiny-old", "lacking": "prior.placing"}
    name, version = publish_tiny(served.database, served.stores.artifacts, **old)
    with pytest.raises(LiveSessionEnded, match=r"\(1008\): model_unreadable: it lacks 'prior.placing'"):
        opened(client.live.open(name, version))
    elsewhere = served.url.replace("http", "ws") + "/no"
    monkeypatch.setattr("physworld_client.live.live_frames.address", lambda *_: elsewhere)
    with pytest.raises(ConnectionFailed, match=r"no live session at http://127.*rejected"):
        opened(client.live.open(served.model))


def test_a_silent_service_is_not_waited_for_for_ever(served: Served) -> None:
    with Client(served.url, served.token, timeout=1.0) as client, client.live.open(served.model) as session:
        session._timeout = 1e-9
        with pytest.raises(RequestTimedOut, match="sent nothing within"):
            for _ in range(200):
                session.frame()


class _Lossy(httpx.HTTPTransport):
    """A real connection that loses its first answer."""

    lost = False

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        response = super().handle_request(request)
        if not self.lost:
            self.lost = True
            response.close()
            raise httpx.RemoteProtocolError("the line broke", request=request)
        return response


def test_a_ticket_whose_answer_was_lost_is_asked_for_anew(served: Served) -> None:
    """The repeated request gets the replay, which holds no ticket."""
    with Client(served.url, served.token, transport=_Lossy()) as client:
        with client.live.open(served.model) as session:
            assert session.frame().points.shape == (4, 3)


def test_the_asynchronous_session_is_the_same(served: Served) -> None:
    async def lift() -> float:
        async with AsyncClient(served.url, served.token) as client:
            async with client.live.open(served.model, frames=2) as session:
                count = 0
                async for frame in session:
                    await session.steer(UP)
                    count += 1
                    if count == 50:
                        return float(frame.controllers[0, 2] - session.start.controllers[0, 2])
        return 0.0

    assert asyncio.run(lift()) > 0.03
