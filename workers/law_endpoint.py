"""A vision-language model behind any OpenAI-compatible endpoint: one chat completion with images, its text.

Configured by PHYSWORLD_LAW_URL (base, such as http://127.0.0.1:8000/v1), PHYSWORLD_LAW_MODEL, PHYSWORLD_LAW_KEY
(none: no Authorization header) and PHYSWORLD_LAW_TIMEOUT_S (for the whole exchange; 60). Whatever goes wrong is one
:class:`~physworld.errors.LawAnswerUnavailable` with its reason; the key appears in none.
"""

from __future__ import annotations

import base64
import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import httpx

from physworld.errors import LawAnswerUnavailable
from physworld_schemas.wording import reason

VARIABLES = ("PHYSWORLD_LAW_URL", "PHYSWORLD_LAW_MODEL", "PHYSWORLD_LAW_KEY", "PHYSWORLD_LAW_TIMEOUT_S")
TIMEOUT_S = 60.0
LONGEST_ANSWER = 1 << 20
LONGEST_TOLD = 200


@dataclass(frozen=True)
class LawEndpoint:
    """Asks the model; see :class:`physworld.calibrate.law_choice.Ask`.

    Attributes:
        base_url: up to and without ``/chat/completions``.
        name: the model's name.
        key: bearer token, or None.
        timeout_s: for the whole exchange.
    """

    base_url: str
    name: str
    key: str | None = field(default=None, repr=False)
    timeout_s: float = TIMEOUT_S

    def __call__(self, prompt: str, images: list[bytes]) -> str:
        """The text of the model's answer. Raises LawAnswerUnavailable."""
        pictures = [
            {
                "type": "image_url",
                "image_url": {"url": "data:image/png;base64," + base64.b64encode(png).decode()},
            }
            for png in images
        ]
        body = {
            "model": self.name,
            "temperature": 0,
            "messages": [{"role": "user", "content": [{"type": "text", "text": prompt}, *pictures]}],
        }
        headers = {} if self.key is None else {"Authorization": f"Bearer {self.key}"}
        try:
            raw = self._exchange(body, headers)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise LawAnswerUnavailable(f"{self.base_url}: {reason(error)}") from error
        return _text_of(raw, self.base_url)

    def _exchange(self, body: dict[str, Any], headers: dict[str, str]) -> bytes:
        """The answer's bytes, within the time for the whole exchange and a sane size."""
        end = time.monotonic() + self.timeout_s
        url = self.base_url.rstrip("/") + "/chat/completions"
        parts, size = [], 0
        with httpx.stream("POST", url, json=body, headers=headers, timeout=self.timeout_s) as answer:
            for part in answer.iter_bytes():
                parts.append(part)
                size += len(part)
                if time.monotonic() > end:
                    raise LawAnswerUnavailable(f"{self.base_url}: no whole answer within {self.timeout_s} s")
                if size > LONGEST_ANSWER:
                    raise LawAnswerUnavailable(
                        f"{self.base_url}: an answer of more than {LONGEST_ANSWER} bytes"
                    )
        raw = b"".join(parts)
        if not answer.is_success:
            told = raw.decode(errors="replace")[:LONGEST_TOLD]
            raise LawAnswerUnavailable(
                f"{self.base_url}: status {answer.status_code}: {' '.join(told.split())}"
            )
        return raw


def law_endpoint(environment: Mapping[str, str] | None = None) -> LawEndpoint | None:
    """The configured endpoint, or None where no address is set.

    Raises:
        ValueError: an address without a model, or a timeout that is no positive number.
    """
    given = os.environ if environment is None else environment
    url, model, key, timeout = (given.get(name, "").strip() for name in VARIABLES)
    if not url:
        return None
    if not model:
        raise ValueError(f"{VARIABLES[0]} is set, {VARIABLES[1]} is not: which model shall be asked?")
    try:
        seconds = float(timeout) if timeout else TIMEOUT_S
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise ValueError(f"{VARIABLES[3]} is {timeout!r}, not a positive number of seconds")
    return LawEndpoint(url, model, key or None, seconds)


def _text_of(raw: bytes, base_url: str) -> str:
    try:
        text = json.loads(raw)["choices"][0]["message"]["content"]
    except (ValueError, LookupError, TypeError) as error:
        told = raw.decode(errors="replace")[:LONGEST_TOLD]
        raise LawAnswerUnavailable(f"{base_url}: no chat completion: {' '.join(told.split())}") from error
    if not isinstance(text, str) or not text.strip():
        raise LawAnswerUnavailable(f"{base_url}: the completion holds no text")
    return text
