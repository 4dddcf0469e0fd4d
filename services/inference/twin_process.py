"""The process that runs a twin beside a live session: ``python -m physworld_services.inference.twin_process``.

The engine records its launches in one place of a process, and a body that blows up should take nobody along: each twin
has a process of its own, which ends with the pipe to the service (``physworld_services.inference.companion``).

Messages both ways are a letter, a uint32 length (little-endian), and so many bytes:

``B`` JSON            begin: ``dt_s``, ``index`` (the particles that are the graph's vertices), ``device``, ``start``
                      (control points at the ticks up to the session's first) and ``start_s`` (time of the first of
                      them); then ``N``, the twin's npz
``C`` float64 (K, 3)  a tick, in which the control points go there; answered by ``V``
``F`` JSON            ``factors`` and ``strengths`` by name: the motion goes on with them
``R``                 back to the start
``r`` JSON            begun: the ``strengths`` of the twin's effects
``V`` float64, float32 (n, 3)   seconds of computing, and the vertices [m]
``X`` JSON            ``reason``: why it cannot be run, or broke off; after the latter ``R`` begins again
"""

from __future__ import annotations

import io
import json
import math
import os
import signal
import struct
import sys
import time
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from physworld.arrays import Array
from physworld.effects.base import Effect
from physworld.effects.registry import effect
from physworld.errors import PhysworldError
from physworld.report.names import label
from physworld.twin.live import LiveTwin
from physworld.twin.twin import Twin
from physworld.worldmodel.model.properties import DENSITY, FRICTION, STIFFNESS

HEAD = struct.Struct("<cI")
PR_SET_PDEATHSIG = 1
LEAD_SHARE = 1e-3  # of a tick: a shorter way from the release to the first tick is none


class Body:
    """A twin in a session's hands."""

    def __init__(self, asked: Mapping[str, Any], arrays: dict[str, Array]) -> None:
        """Raises PhysworldError for a twin that cannot be run live."""
        self._calibrated = self._twin = Twin.from_arrays(arrays, asked["device"])
        self._index = np.array(asked["index"], dtype=np.int64)
        self._start = np.array(asked["start"], dtype=np.float64)
        self._dt_s, lead = float(asked["dt_s"]), float(asked["start_s"]) - self._twin.release_s
        self._lead_s = lead if lead > LEAD_SHARE * self._dt_s else 0.0
        self._properties: Array | None = None
        self.reset()

    @property
    def vertices(self) -> Array:
        """Vertices of the graph now, (n, 3) [m]."""
        return self._live.particles[self._index]

    @property
    def strengths(self) -> list[dict[str, Any]]:
        """Strengths of the twin's effects, each with its unit, its bounds and its calibrated value; JSON types."""
        found = []
        for known in self._calibrated.effects:
            for one in type(known).strengths(self._calibrated):
                value = known.values.get(one.name)
                if value is None or not one.gate:
                    continue
                name = f"{known.name}.{one.name}"
                low, high = min(one.low, value), max(one.high, value)
                told = {"name": name, "label": label(name), "unit": one.unit}
                found.append({**told, "low": low, "high": high, "value": value})
        return found

    def reset(self) -> None:
        """To the session's start, by way of the recorded controls before it."""
        self._live = LiveTwin(self._twin, self._dt_s, properties=self._properties, lead_s=self._lead_s)
        for places in self._start if self._lead_s else self._start[1:]:
            self._live.step(places)

    def step(self, controllers: Array) -> None:
        """A tick."""
        self._live.step(controllers)

    def change(self, factors: Mapping[str, float], strengths: Mapping[str, float]) -> None:
        """Go on with properties relative to the twin's own, and strengths by name; others are the twin's own."""
        twin = self._calibrated
        if FRICTION in strengths and twin.ground_height_m is not None:
            twin = twin.with_parameters(ground_friction=strengths[FRICTION])
        for known in self._calibrated.effects:
            twin = twin.with_effect(_at(known, strengths))
        logs = [math.log(factors.get(name, 1.0)) for name in (STIFFNESS, DENSITY)]
        self._properties = np.tile(logs, (len(twin.particles_rest), 1)) if any(logs) else None
        self._twin = twin
        self._live = self._live.changed(twin, self._properties)


def _at(known: Effect, strengths: Mapping[str, float]) -> Effect:
    own = {name: strengths.get(f"{known.name}.{name}", value) for name, value in known.values.items()}
    return effect(known.name, **own)


def main() -> int:
    """Serve until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to act on
    _die_with_parent()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    body: Body | None = None
    asked: dict[str, Any] = {}
    while (message := _read(sys.stdin.buffer)) is not None:
        kind, content = message
        try:
            if kind == b"B":
                asked = json.loads(content)
            elif kind == b"N":
                with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                    body = Body(asked, {name: archive[name] for name in archive.files})
                _write(answers, b"r", json.dumps({"strengths": body.strengths}).encode())
            elif body is not None:
                _act(body, kind, content, answers)
        except PhysworldError as error:
            _write(answers, b"X", json.dumps({"reason": str(error)}).encode())
    return 0


def _act(body: Body, kind: bytes, content: bytes, answers: BinaryIO) -> None:
    if kind == b"C":
        started = time.perf_counter()
        body.step(np.frombuffer(content).reshape(-1, 3))
        seconds = struct.pack("<d", time.perf_counter() - started)
        _write(answers, b"V", seconds + body.vertices.astype("<f4").tobytes())
    elif kind == b"F":
        told = json.loads(content)
        body.change(told["factors"], told["strengths"])
    elif kind == b"R":
        body.reset()


def _read(stream: BinaryIO) -> tuple[bytes, bytes] | None:
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    kind, length = HEAD.unpack(head)
    return kind, stream.read(length)


def _write(stream: BinaryIO, kind: bytes, content: bytes) -> None:
    stream.write(HEAD.pack(kind, len(content)) + content)
    stream.flush()


def _die_with_parent() -> None:
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
