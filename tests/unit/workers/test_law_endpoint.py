"""The model's endpoint against a local server that speaks the protocol, over real sockets."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chat_model import completion, serving
from made_scene import made_scene
from PIL import Image

from physworld.errors import LawAnswerUnavailable
from physworld_workers.law_endpoint import LawEndpoint, law_endpoint
from physworld_workers.motion_picture import motion_pictures

ANSWER = "Elastic: FCR | Plastic: Purely Elastic | Reason: it turns more than it stretches"
KEY = "secret-of-the-test"


@pytest.fixture
def server() -> Iterator[Any]:
    with serving(ANSWER) as served:
        yield served


def endpoint(server: Any, **options: Any) -> LawEndpoint:
    return LawEndpoint(server.url, "eye-1", **options)


def test_a_chat_completion_with_pictures_is_asked_and_its_text_returned(server: Any) -> None:
    scene = made_scene(np.random.default_rng(0).uniform(size=(9, 3)), "blob")
    pictures = motion_pictures(scene)
    assert endpoint(server, key=KEY)("what is it?", pictures) == ANSWER
    ((path, headers, body),) = server.asked
    assert path == "/v1/chat/completions" and headers["Authorization"] == f"Bearer {KEY}"
    (message,) = body["messages"]
    assert body["model"] == "eye-1" and message["role"] == "user"
    assert message["content"][0] == {"type": "text", "text": "what is it?"}
    head, _, data = message["content"][1]["image_url"]["url"].partition(",")
    assert head == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
        assert picture.size == (1280, 640)
        assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 5  # something is drawn


def test_without_a_key_no_authorization_is_sent(server: Any) -> None:
    endpoint(server)("?", [])
    assert "Authorization" not in server.asked[0][1]


@pytest.mark.parametrize(
    ("status", "content", "word"),
    [
        (500, b"out of\nmemory", "status 500: out of memory"),
        (401, b"who are you?", "status 401"),
        (200, b"<html>hello</html>", "no chat completion: <html>"),
        (200, b'{"choices": []}', "no chat completion"),
        (200, b'{"choices": [{"message": null}]}', "no chat completion"),
        (200, completion(None), "holds no text"),
        (200, completion("  "), "holds no text"),
        (200, completion([{"type": "text"}]), "holds no text"),
    ],
)
def test_what_is_no_answer_is_unavailable_with_its_reason(
    server: Any, status: int, content: bytes, word: str
) -> None:
    server.status, server.content = status, content
    with pytest.raises(LawAnswerUnavailable, match=word) as caught:
        endpoint(server, key=KEY)("?", [])
    assert KEY not in str(caught.value) and KEY not in repr(endpoint(server, key=KEY))


def test_a_model_that_sleeps_is_not_waited_for(server: Any) -> None:
    server.delay_s = 30.0
    begun = time.monotonic()
    with pytest.raises(LawAnswerUnavailable, match="timed out"):
        endpoint(server, timeout_s=0.3)("?", [])
    assert time.monotonic() - begun < 10.0


def test_nobody_there_is_unavailable() -> None:
    with pytest.raises(LawAnswerUnavailable, match="refused"):
        LawEndpoint("http://127.0.0.1:9/v1", "eye-1", timeout_s=2.0)("?", [])
    with pytest.raises(LawAnswerUnavailable, match="missing an"):
        LawEndpoint("nowhere", "eye-1")("?", [])


def test_the_environment_configures_it() -> None:
    assert law_endpoint({}) is None
    given = {"PHYSWORLD_LAW_URL": "http://x/v1", "PHYSWORLD_LAW_MODEL": "m", "PHYSWORLD_LAW_TIMEOUT_S": "7.5"}
    assert law_endpoint(given) == LawEndpoint("http://x/v1", "m", None, 7.5)
    with pytest.raises(ValueError, match="PHYSWORLD_LAW_MODEL is not"):
        law_endpoint({"PHYSWORLD_LAW_URL": "http://x/v1"})
    with pytest.raises(ValueError, match="'soon'"):
        law_endpoint({**given, "PHYSWORLD_LAW_TIMEOUT_S": "soon"})
