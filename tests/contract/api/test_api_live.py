"""Live sessions through the API: who gets in, what comes back, what ends a session."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from inference_serving import Served, serve_inference
from published_tiny import publish_tiny, tiny_model
from serving import log_in
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from physworld.twin.live import LiveTwin
from physworld_schemas.model import TrainingConfig
from physworld_services.api.attempts import PER_ADDRESS
from physworld_services.api.routes import live as api_live
from physworld_services.inference import live
from physworld_services.inference.companion import MOST_BEHIND_S
from physworld_services.inference.session import HEAD, OF_TWIN
from physworld_storage import registry
from physworld_storage.access import api_keys

WITHIN_S = 20.0
TWIN_S = 200.0
"""A twin's process loads the engine first, which takes its time on a busy machine."""
SINGLE_PRECISION_M = 2e-6


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        yield served


def path_of(served: Served) -> str:
    with served.client() as client:
        answer = client.post("/v1/live/tickets", json={"model": served.model})
    assert answer.status_code == 201, answer.text
    return answer.json()["path"]


def address(served: Served, path: str) -> str:
    return served.url.replace("http", "ws", 1) + path


def run(
    served: Served,
    work: Callable[[ClientConnection, dict], Awaitable[None]],
    frames: int = 1,
    within_s: float = WITHIN_S,
) -> None:
    """Open a session with a ticket and do ``work`` with it and the first message."""

    async def session() -> None:
        where = address(served, f"{path_of(served)}&frames={frames}")
        async with connect(where, proxy=None) as socket:
            await asyncio.wait_for(work(socket, json.loads(await socket.recv())), within_s)

    asyncio.run(session())


def frame(message: bytes | str, ready: dict) -> tuple[tuple, np.ndarray, np.ndarray]:
    assert isinstance(message, bytes)
    places = np.frombuffer(message, "<f4", offset=HEAD.size).reshape(-1, 3)
    assert len(places) == ready["points"] + len(ready["controllers"])
    return HEAD.unpack_from(message), places[: ready["points"]], places[ready["points"] :]


def control(number: int, velocity: list[float], rows: int = 1) -> bytes:
    return struct.pack("<I", number) + np.tile(np.array(velocity, "<f4"), (rows, 1)).tobytes()


def test_points_follow_the_controls_as_a_rollout_would(served: Served) -> None:
    model = tiny_model()[2]

    async def work(socket: ClientConnection, ready: dict) -> None:
        assert ready["type"] == "ready"
        assert ready["grips"] == [[0, 1, 2, 3]]
        path, number = [], 0
        while len(path) < 20:
            number += 1
            await socket.send(control(number, [0.0, 0.1, 0.0]))
            head, points, controllers = frame(await socket.recv(), ready)
            path.append((head[0], points, controllers))
        ticks = [tick for tick, _, _ in path]
        assert ticks == list(range(ticks[0], ticks[0] + 20))  # none was left out
        driven = np.concatenate([model.start_controllers, [c.astype(float) for _, _, c in path]])
        assert driven[-1, 0, 1] - driven[2, 0, 1] > 0.03
        if ticks[0] == 1:  # from the session's first tick on it is a rollout under what the grips did
            expected = model.skin.apply(model.rollout(driven)[3:])
            assert np.array([points for _, points, _ in path]) == pytest.approx(expected, abs=2e-5)

    run(served, work)


def test_frames_come_at_the_models_clock_or_faster(served: Served) -> None:
    async def work(socket: ClientConnection, ready: dict) -> None:
        await socket.recv()
        started, count = time.monotonic(), 0
        while time.monotonic() - started < 2.0:
            await socket.recv()
            count += 1
        assert 30.0 <= count / 2.0 <= 75.0  # two a tick of 1/30 s

    run(served, work, frames=2)


def test_the_vertices_of_the_graph_can_be_had_instead(served: Served) -> None:
    async def session() -> None:
        async with connect(address(served, f"{path_of(served)}&part=vertices"), proxy=None) as socket:
            ready = json.loads(await socket.recv())
            assert ready["points"] == 20
            _, points, _ = frame(await socket.recv(), ready)
            assert np.isfinite(points).all()

    asyncio.run(session())


def test_speed_and_reach_are_cut_and_silence_stops_the_grips(served: Served) -> None:
    async def work(socket: ClientConnection, ready: dict) -> None:
        start = np.array(ready["controllers"])
        far, number, before = 0.0, 0, start
        for _ in range(60):
            number += 1
            await socket.send(control(number, [0.0, 0.0, 50.0], rows=4))
            _, _, controllers = frame(await socket.recv(), ready)
            assert np.abs(controllers - before).max() <= ready["speed_m_s"] * ready["dt_s"] * 2.5 + 1e-5
            before, far = controllers, float((controllers - start)[:, 2].max())
        assert far == pytest.approx(ready["reach_m"], abs=1e-5)
        await socket.send(control(number + 1, [0.0, 0.0, -0.1]))
        until = time.monotonic() + live.HOLD_S + 0.4
        while time.monotonic() < until:
            _, _, held = frame(await socket.recv(), ready)
        _, _, later = frame(await socket.recv(), ready)
        assert np.array_equal(held, later)
        await socket.send(json.dumps({"type": "reset"}))
        for _ in range(10):
            _, _, again = frame(await socket.recv(), ready)
        assert again == pytest.approx(start, abs=1e-6)

    run(served, work)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (b"\x01\x00\x00\x00abc", "bytes"),
        (control(1, [0.0, float("nan"), 0.0]), "finite"),
        ("no json", "Expecting"),
        ("[" * 60_000, ""),
        ("[]", "get"),
        ('{"type": "factors"}', "factors"),
        ('{"type": "factors", "factors": 3}', ""),
        ('{"type": "factors", "factors": {"colour": 2}}', "no property"),
        (b"x" * 100_000, "bytes"),
    ],
)
def test_a_message_that_cannot_be_meant_ends_the_session(served: Served, message: bytes, words: str) -> None:
    async def work(socket: ClientConnection, ready: dict) -> None:
        await socket.send(message)
        with pytest.raises(ConnectionClosed) as ended:
            while True:
                await socket.recv()
        assert ended.value.rcvd is not None
        assert ended.value.rcvd.code in {1007, 1009}
        assert words in ended.value.rcvd.reason

    run(served, work)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"lacking": "prior.placing"}, "it lacks 'prior.placing'"),
        ({"changed": {"prior.response": lambda values: values[0]}}, "the prior has response (6, 19)"),
        ({"changed": {"prior.weight": lambda values: values[:, 1:]}}, "the prior has weight (6, "),
        ({"changed": {"phi": lambda values: np.pad(values, ((0, 0), (0, 1)))}}, "phi (20, 3), not (20, 2)"),
        (
            {"changed": {"start.history": lambda values: values[1:]}},
            "start.history (2, 20, 3), not (3, 20, 3)",
        ),
        ({"card": {"schema_version": 7}}, "with a card of layout 7"),
    ],
)
def test_a_version_that_cannot_be_read_is_refused_by_its_code(served: Served, told: dict, words: str) -> None:
    """Not a broken line: a client learns what it is that cannot be read, and others go on."""
    written = {"versions": {"physworld": "physworld 0.0.7"}}
    told = told | {"card": written | told.get("card", {})}
    name, version = publish_tiny(served.database, served.stores.artifacts, name="tiny-old", **told)
    plain = f"/v1/live?{urlencode({'model': name, 'version': version})}"

    async def refused() -> None:
        key = {"Authorization": f"Bearer {served.token}"}
        async with connect(address(served, plain), proxy=None, additional_headers=key) as socket:
            with pytest.raises(ConnectionClosed) as ended:
                await asyncio.wait_for(socket.recv(), WITHIN_S)
        assert ended.value.rcvd is not None
        assert ended.value.rcvd.code == 1008
        assert ended.value.rcvd.reason.startswith("model_unreadable: ")
        assert words in ended.value.rcvd.reason

    for _ in range(live.MOST_SESSIONS + 1):  # a refused session takes no place
        asyncio.run(refused())
    with served.client() as client:
        asked = {"model": name, "version": version, "controllers": tiny_model()[2].start_controllers.tolist()}
        whole = client.post("/v1/rollouts", json=asked)
    assert (whole.status_code, whole.json()["code"]) == (409, "model_unreadable")
    assert words in whole.json()["detail"] and "Train it anew" in whole.json()["detail"]

    async def work(socket: ClientConnection, ready: dict) -> None:
        assert ready["type"] == "ready"

    run(served, work)


def test_files_of_another_format_are_no_broken_line_either(served: Served) -> None:
    name, version = publish_tiny(
        served.database, served.stores.artifacts, name="tiny-old", weights=b"no tensors"
    )

    async def refused() -> str:
        with served.client() as client:
            path = client.post("/v1/live/tickets", json={"model": name, "version": version}).json()["path"]
        async with connect(address(served, path), proxy=None) as socket:
            with pytest.raises(ConnectionClosed) as ended:
                await asyncio.wait_for(socket.recv(), WITHIN_S)
        assert ended.value.rcvd is not None
        return ended.value.rcvd.reason

    assert asyncio.run(refused()).startswith("model_unreadable: its files are of another format")


def test_the_reason_of_a_refusal_fits_a_frame(served: Served) -> None:
    """123 bytes of UTF-8, whatever the client called the model."""
    plain = f"/v1/live?{urlencode({'model': 'ä' * 200, 'version': 1})}"
    code, reason = refusal(served, plain, {"Authorization": f"Bearer {served.token}"})
    assert code == 1008
    assert reason.startswith("not_found: ") and 120 <= len(reason.encode()) <= 123


def refusal(served: Served, path: str, headers: dict[str, str] | None = None) -> tuple[int, str]:
    """Code and reason with which the session is refused."""

    async def refused() -> tuple[int, str]:
        async with connect(address(served, path), proxy=None, additional_headers=headers) as socket:
            with pytest.raises(ConnectionClosed) as ended:
                await asyncio.wait_for(socket.recv(), WITHIN_S)
        assert ended.value.rcvd is not None
        return ended.value.rcvd.code, ended.value.rcvd.reason

    return asyncio.run(refused())


def test_a_stranger_does_not_learn_which_models_exist(served: Served) -> None:
    strangers = ({"Authorization": "Bearer x"}, {"Authorization": "Basic x"}, None)
    answers = {
        refusal(served, f"/v1/live?{urlencode({'model': model, 'version': version, **ticket})}", headers)
        for model, version in ((served.model, served.version), (served.model, 7), ("nobody", 1))
        for ticket, headers in (*(({}, header) for header in strangers), ({"ticket": "x"}, None))
    }
    ((code, reason),) = answers
    assert code == 1008 and reason.startswith("unauthenticated: ")


def test_wrong_keys_are_limited_here_as_over_http(tmp_path: Path) -> None:
    with serve_inference(tmp_path) as alone:
        path = f"/v1/live?{urlencode({'model': alone.model, 'version': alone.version})}"
        answers = [
            refusal(alone, path, {"Authorization": f"Bearer guess-{turn}"})[1]
            for turn in range(PER_ADDRESS + 1)
        ]
    assert {answer.partition(":")[0] for answer in answers[:-1]} == {"unauthenticated"}
    assert answers[-1].startswith("too_many_attempts: too many wrong keys from this address; try again in ")


def test_a_version_of_too_many_digits_is_not_found(served: Served) -> None:
    digits = "9" * 5000
    path = f"/v1/live?{urlencode({'model': served.model, 'version': digits})}"
    code, reason = refusal(served, path, {"Authorization": f"Bearer {served.token}"})
    assert code == 1008 and reason.startswith("not_found: ")
    with served.client() as client:
        page = client.get(
            f"/dashboard/models/{served.model}/{digits}", headers=log_in(served.url, served.token)
        )
    assert page.status_code == 404


def test_the_playground_is_for_whoever_may_write_and_of_a_ready_version(served: Served) -> None:
    with served.database.session() as session:
        _, reader = api_keys.create_key(session, "reader", "read")
        pending = registry.allot_version(session, served.model, config=TrainingConfig()).version
    here = f"/dashboard/models/{served.model}/{served.version}"
    with served.client() as client:
        for token, allowed in ((served.token, True), (reader, False)):
            headers = log_in(served.url, token)
            assert ("/playground" in client.get(here, headers=headers).text) == allowed
            assert client.get(f"{here}/playground", headers=headers).status_code == (200 if allowed else 403)
            assert client.post(f"{here}/live", headers=headers).status_code == (200 if allowed else 403)
        not_yet = f"/dashboard/models/{served.model}/{pending}/live"
        refused = client.post(not_yet, headers=log_in(served.url, served.token))
    assert refused.status_code == 409 and "pending" in refused.text


def test_a_ticket_is_good_once_and_for_its_model_only(served: Served) -> None:
    path = path_of(served)

    async def refused(where: str, headers: dict[str, str] | None = None) -> int:
        async with connect(address(served, where), proxy=None, additional_headers=headers) as socket:
            try:
                text = await socket.recv()
                return json.loads(text)["points"]
            except ConnectionClosed as ended:
                assert ended.rcvd is not None
                return ended.rcvd.code

    plain = f"/v1/live?{urlencode({'model': served.model, 'version': served.version})}"
    with served.database.session() as session:
        _, reader = api_keys.create_key(session, "reader", "read")
    assert asyncio.run(refused(path)) == 4
    assert asyncio.run(refused(path)) == 1008
    assert asyncio.run(refused(path_of(served).replace("version=1", "version=7"))) == 1008
    assert asyncio.run(refused(plain)) == 1008
    assert asyncio.run(refused(plain, {"Authorization": f"Bearer {served.token}"})) == 4
    assert asyncio.run(refused(plain, {"Authorization": f"Bearer {reader}"})) == 1008
    assert asyncio.run(refused("/v1/live?model=nobody&version=1&ticket=x")) == 1008
    with served.client(reader) as client:
        assert client.post("/v1/live/tickets", json={"model": served.model}).status_code == 403


def test_sessions_are_limited_and_a_place_is_free_again_when_one_ends(served: Served) -> None:
    async def work() -> None:
        sockets: list[ClientConnection] = []
        while len(sockets) < live.MOST_SESSIONS:  # those of the tests before end in their own time
            socket = await connect(address(served, path_of(served)), proxy=None)
            try:
                await socket.recv()
            except ConnectionClosed:
                await socket.close()
                await asyncio.sleep(0.1)
                continue
            sockets.append(socket)
        async with connect(address(served, path_of(served)), proxy=None) as one_more:
            with pytest.raises(ConnectionClosed) as ended:
                await one_more.recv()
            assert ended.value.rcvd is not None
            assert ended.value.rcvd.code == 1013
        for socket in sockets:
            await socket.close()
        for _ in range(100):
            async with connect(address(served, path_of(served)), proxy=None) as again:
                try:
                    assert json.loads(await again.recv())["type"] == "ready"
                    return
                except ConnectionClosed:
                    await asyncio.sleep(0.05)
        raise AssertionError("no place became free")

    asyncio.run(asyncio.wait_for(work(), 60.0))


def many(values: np.ndarray) -> np.ndarray:
    """The same points so often that their frames fill a connection's buffers at once."""
    return np.tile(values, (20_000, 1))


CROWDED = {"changed": {"skin.index": many, "skin.weight": many}}


def test_a_client_that_reads_no_more_loses_its_place(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of its session waits neither for it to read the close frame nor for the system to give it up."""
    monkeypatch.setattr(live, "SEND_S", 0.5)
    monkeypatch.setattr(api_live, "SEND_S", 0.5)
    name, version = publish_tiny(served.database, served.stores.artifacts, name="tiny-crowd", **CROWDED)
    plain = f"/v1/live?{urlencode({'model': name, 'version': version})}"
    key = {"Authorization": f"Bearer {served.token}"}

    async def work() -> None:
        stalled = [
            await connect(
                address(served, plain),
                proxy=None,
                additional_headers=key,
                compression=None,  # or thousands of such frames would fit into the buffers
                max_size=2**26,
                max_queue=1,
            )
            for _ in range(live.MOST_SESSIONS)
        ]
        for socket in stalled:
            assert json.loads(await socket.recv())["points"] == 80_000  # more than 4 MiB of text
        for _ in range(150):
            async with connect(address(served, path_of(served)), proxy=None) as again:
                try:
                    assert json.loads(await again.recv())["type"] == "ready"
                    break
                except ConnectionClosed:
                    await asyncio.sleep(0.1)
        else:
            raise AssertionError("no place became free")
        for socket in stalled:
            socket.transport.abort()
            await socket.wait_closed()

    asyncio.run(asyncio.wait_for(work(), 60.0))


def twin_text(texts: list[dict], state: str) -> dict | None:
    return next((told for told in reversed(texts) if told["state"] == state), None)


def test_the_twin_runs_beside_the_model_on_the_same_grips(served: Served) -> None:
    """In step, each at its own colour of frames: the twin's are those of the engine under what the grips did."""
    _, twin, model = tiny_model()

    async def work(socket: ClientConnection, ready: dict) -> None:
        texts: list[dict] = []
        driven: dict[int, np.ndarray] = {}
        bodies: dict[int, np.ndarray] = {}
        await socket.send(json.dumps({"type": "twin", "on": True}))
        number, newest, step = 0, 0, 0
        while len(bodies) < 60 or newest - step > 3:  # as many frames, and at their end in step
            message = await socket.recv()
            if isinstance(message, str):
                texts.append(json.loads(message))
                continue
            head, points, controllers = frame(message, ready)
            if twin_text(texts, "running") is None:
                continue
            number += 1
            if len(bodies) < 60:
                await socket.send(control(number, [0.0, 0.0, 0.1 * np.sin(0.2 * number)]))
            if head[3] & OF_TWIN:
                bodies[head[0]], step = points, head[0]
            else:
                if head[0] < newest:  # both begin anew once the twin is there
                    driven, bodies, step = {}, {}, 0
                newest = head[0]
            driven[head[0]] = controllers.astype(float)
        assert texts[0] == {"type": "twin", "state": "starting"}
        told = twin_text(texts, "running")
        assert told is not None and told["strengths"] == [] and told["behind_s"] < MOST_BEHIND_S
        last = max(tick for tick in bodies if all(before in driven for before in range(1, tick + 1)))
        assert last > 30
        path = np.concatenate([model.start_controllers, [driven[tick] for tick in range(1, last + 1)]])
        alone = LiveTwin(twin, model.spec.dt_s)
        for places in path[1:]:
            particles = alone.step(places)
        expected = model.skin.apply(particles[model.spec.particle_index][None])[0]
        assert np.abs(path[-1] - path[0]).max() > 5e-3
        assert bodies[last] == pytest.approx(expected, abs=5e-4)

    run(served, work, within_s=TWIN_S)


def test_a_twin_that_cannot_be_run_live_is_refused_in_words_and_the_session_goes_on(served: Served) -> None:
    name, version = publish_tiny(
        served.database,
        served.stores.artifacts,
        name="tiny-slips",
        acting=("grip_slip", {"compliance_m_n": 1e-3}),
    )

    async def session() -> None:
        with served.client() as client:
            path = client.post("/v1/live/tickets", json={"model": name, "version": version}).json()["path"]
        async with connect(address(served, path), proxy=None) as socket:
            ready = json.loads(await socket.recv())
            await socket.send(json.dumps({"type": "twin", "on": True}))
            told = None
            while told is None or told["state"] == "starting":
                message = await asyncio.wait_for(socket.recv(), TWIN_S)
                told = json.loads(message) if isinstance(message, str) else told
            assert told["state"] == "refused"
            assert "grip_slip pulls along the whole path of the grips" in told["reason"]
            while isinstance(message := await socket.recv(), str):
                pass
            frame(message, ready)

    asyncio.run(session())


def test_strengths_that_the_model_was_not_trained_over_act_on_the_twin_alone(served: Served) -> None:
    drag = ("air_drag_linear", {"rate_per_s": 2.0})
    name, version = publish_tiny(served.database, served.stores.artifacts, name="tiny-acting", acting=drag)

    async def session() -> None:
        with served.client() as client:
            path = client.post("/v1/live/tickets", json={"model": name, "version": version}).json()["path"]
        async with connect(address(served, path), proxy=None) as socket:
            ready = json.loads(await socket.recv())
            assert ready["strengths"] == []
            await socket.send(json.dumps({"type": "twin", "on": True}))
            told, moved, number, asked = None, [], 0, False
            while len(moved) < 40:
                message = await asyncio.wait_for(socket.recv(), TWIN_S)
                if isinstance(message, str):
                    told = json.loads(message)
                    continue
                if told is None or told["state"] != "running":
                    continue
                (strength,) = told["strengths"]
                assert (strength["name"], strength["unit"]) == ("air_drag_linear.rate_per_s", "1/s")
                assert strength["low"] <= strength["value"] == 2.0 < strength["high"]
                if not asked:
                    told_strengths = {"factors": {}, "strengths": {strength["name"]: strength["high"]}}
                    await socket.send(json.dumps({"type": "factors", **told_strengths}))
                    asked = True
                head, points, _ = frame(message, ready)
                if head[3] & OF_TWIN:
                    moved.append(points)
                number += 1
                await socket.send(control(number, [0.0, 0.0, 0.05]))
            await socket.send(
                json.dumps({"type": "factors", "factors": {}, "strengths": {strength["name"]: 1e9}})
            )
            with pytest.raises(ConnectionClosed) as ended:
                while True:
                    await asyncio.wait_for(socket.recv(), TWIN_S)
            assert ended.value.rcvd is not None and "it may be" in ended.value.rcvd.reason

    asyncio.run(session())
