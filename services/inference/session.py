"""One live session without its connection: limits on the controls, ticks, the frames that are sent.

A frame is little-endian: uint32 tick, uint32 number of the last control message, float32 time [s], uint32 flags
(1: the prediction had left the numbers and was set back; 2: the body is the twin's), then float32 points (N, 3) and
controllers (K, 3) [m].
A control message is uint32 its number, then float32 velocities [m/s], (G, 3) for the grips or (K, 3).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.report.names import label
from physworld.worldmodel.controls import grip_groups
from physworld.worldmodel.live import LiveRollout
from physworld.worldmodel.model.properties import PhiColumn
from physworld.worldmodel.published import PublishedModel

HEAD = struct.Struct("<IIfI")
SET_BACK, OF_TWIN = 1, 2
SPEED_PER_SIZE, REACH_PER_SIZE = 4.0, 1.5
"""Largest speed [1/s] and distance of a grip from its start, in sizes of the body."""


MOST_FACTOR = 100.0
"""Of a property of the body, and one over the least."""


def strength_told(model: PublishedModel, column: PhiColumn) -> dict[str, Any]:
    """A strength as a client learns of it: its unit, the range that the training covered, and the model's own value."""
    assert model.strengths is not None
    low, high = model.strengths.range_of(column)
    value = model.strengths.quantities[column.name]
    named = {"name": column.name, "label": label(column.name), "unit": column.unit}
    return {**named, "low": low, "high": high, "value": value}


def checked_strength(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> None:
    """Refuses a strength that is no finite number, or outside of its bounds.

    Args:
        name: of the strength.
        value: that was sent.
        low, high: its bounds.

    Raises:
        ControlRefused: with the numbers.
    """
    if not _is_number(value):
        raise ControlRefused(f"the strength {name!r} is not a finite number")
    if not low <= value <= high:
        raise ControlRefused(f"{name} is {value:g}; it may be {low:g} to {high:g}")


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)


class ControlRefused(ValueError):
    """A control message that cannot be meant."""


@dataclass(frozen=True)
class Control:
    """``number`` of the message and velocities of all controllers [m/s], (K, 3)."""

    number: int
    velocity: Array


class LiveSession:
    """A model's body under the controls of one client."""

    def __init__(self, model: PublishedModel, *, vertices: bool = False) -> None:
        """``vertices``: frames hold the graph's object vertices in the place of the measured points."""
        self.dt_s = model.spec.dt_s
        self._model = model
        self._skin = None if vertices else model.skin
        start = model.start_controllers[-1]
        self.groups = tuple(map(np.array, model.grips)) or grip_groups(model.spec, start)
        size = float(np.ptp(model.spec.rest_vertices, axis=0).max())
        self.speed_m_s, self.reach_m = SPEED_PER_SIZE * size, REACH_PER_SIZE * size
        self._start, self._flags = start, 0
        self._strengths = () if model.strengths is None else model.strengths.columns
        self._rollout = LiveRollout(model)
        self._wanted = self._rollout.holding
        self._before = self._now = self._places()

    def describe(self) -> dict[str, Any]:
        """What the client must know before the first frame; JSON types."""
        return {
            "dt_s": self.dt_s,
            "points": len(self._now) - len(self._start),
            "controllers": self._start.tolist(),
            "grips": [group.tolist() for group in self.groups],
            "holding": [list(grips) for grips in self._rollout.sets],
            "speed_m_s": self.speed_m_s,
            "reach_m": self.reach_m,
            "factors": [column.name for column in self._model.columns],
            "strengths": [strength_told(self._model, column) for column in self._strengths],
            "start": self._now[: -len(self._start)].astype(np.float32).tolist(),
        }

    def read(self, message: bytes) -> Control:
        """A control message, its speeds cut to the limit. Raises ControlRefused."""
        grips, count = len(self.groups), len(self._start)
        rows = (len(message) - 4) // 12
        if len(message) != 4 + 12 * rows or rows not in (grips, count):
            raise ControlRefused(
                f"a control message of {len(message)} bytes; it has {4 + 12 * grips} (grips) or {4 + 12 * count}"
            )
        velocity = np.frombuffer(message, dtype="<f4", offset=4).reshape(rows, 3).astype(np.float64)
        if not np.isfinite(velocity).all():
            raise ControlRefused("a velocity is not a finite number")
        if rows != count:
            spread = np.zeros((count, 3))
            for group, one in zip(self.groups, velocity, strict=True):
                spread[group] = one
            velocity = spread
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        velocity = velocity * np.minimum(1.0, self.speed_m_s / np.maximum(speed, 1e-12))
        return Control(struct.unpack_from("<I", message)[0], velocity)

    def set_factors(self, factors: Mapping[str, Any]) -> None:
        """Properties of the body by name, each relative to the model's own; one that is not named is as in the model.

        They hold from the next tick on, and after a reset. Raises ControlRefused.
        """
        for name, factor in factors.items():
            if not _is_number(factor):
                raise ControlRefused(f"the factor of {name!r} is not a finite number")
            if not 1 / MOST_FACTOR <= factor <= MOST_FACTOR:
                raise ControlRefused(
                    f"the factor of {name!r} is {factor:g}; it may be 0.01 to {MOST_FACTOR:g}"
                )
        columns = [column.name for column in self._model.columns]
        unknown = sorted(set(factors) - set(columns))
        if unknown:
            raise ControlRefused(f"there is no property {unknown[0]!r}; there are {', '.join(columns)}")
        self._rollout.set_phi(self._model.phi + [math.log(factors.get(name, 1.0)) for name in columns])

    def set_strengths(self, strengths: Mapping[str, Any]) -> None:
        """Strengths of effects by name in their units, within what the model was trained over; the others as in it.

        They hold from the next tick on, and after a reset. Raises ControlRefused.
        """
        for name, value in strengths.items():
            checked_strength(name, value)
        try:
            self._rollout.set_model(self._model.at_strengths(strengths))
        except ValueError as error:
            raise ControlRefused(str(error)) from error

    def open_grips(self, grips: Sequence[Any]) -> None:
        """From the next tick on these grips are open, by their numbers from 0, and the others hold.

        An open grip goes along with the material that it held, and closes where it is. Raises ControlRefused.
        """
        count = len(self.groups)
        if any(isinstance(grip, bool) or grip not in range(count) for grip in grips):
            raise ControlRefused(f"grips {list(grips)} are to open; the session has {count}, from 0 on")
        wanted = tuple(grip for grip in self._rollout.own if grip not in grips)
        if wanted not in self._rollout.sets:
            known = ", ".join(str(list(one)) for one in self._rollout.sets)
            raise ControlRefused(f"grips {list(wanted)} would hold; the version has models of {known}")
        self._wanted = wanted

    def reset(self) -> None:
        """Back to the start, where no grip has been opened."""
        self._rollout.reset()
        self._wanted = self._rollout.holding
        self._before = self._now = self._places()

    def tick(self, velocity: Array) -> None:
        """One step of the model under velocities (K, 3) [m/s]; a prediction that left the numbers is set back."""
        self._rollout.hold(self._wanted)
        before = self._rollout.controllers - self._start
        offset = before + self.dt_s * velocity
        for group in self.groups:  # a grip stays rigid where it meets the end of its reach
            middle = offset[group].mean(axis=0)
            reach = np.maximum(self.reach_m, np.abs(before[group].mean(axis=0)))  # it may have closed beyond
            offset[group] += np.clip(middle, -reach, reach) - middle
        self._rollout.step(self._start + offset)
        self._before, self._now = self._now, self._places()
        if not (np.abs(self._now) < 1e3).all():
            self.reset()
            self._flags = SET_BACK

    def frame(self, share: float, number: int) -> bytes:
        """The frame between the last two ticks: ``share`` 1 is the newest. A flag is in all frames until ``sent``.

        Its time, points and controllers are those of that moment; its tick is the newest.
        """
        tick = self._rollout.tick
        head = HEAD.pack(tick, number, max(tick - 1 + share, 0.0) * self.dt_s, self._flags)
        return head + ((1.0 - share) * self._before + share * self._now).astype("<f4").tobytes()

    @property
    def strengths(self) -> list[str]:
        """Names of the strengths that the model was trained over."""
        return [column.name for column in self._strengths]

    @property
    def tick_number(self) -> int:
        """Ticks since the start."""
        return self._rollout.tick

    @property
    def controllers(self) -> Array:
        """Control points now [m], (K, 3)."""
        places: Array = self._rollout.controllers
        return places

    def twin_frame(self, tick: int, vertices: Array, controllers: Array) -> bytes:
        """The frame of the twin at a tick: its vertices (n, 3) under control points (K, 3) [m]."""
        points = vertices if self._skin is None else self._skin.apply(vertices.astype(np.float64))
        head = HEAD.pack(tick, 0, tick * self.dt_s, OF_TWIN)
        return head + np.concatenate([points, controllers]).astype("<f4").tobytes()

    def sent(self, frame: bytes) -> None:
        """The client has this frame, and knows what its flags say; frames that were left out told nobody."""
        self._flags &= ~HEAD.unpack_from(frame)[3]

    def _places(self) -> Array:
        """Points and then controllers now [m], (N + K, 3)."""
        vertices = self._rollout.vertices
        points = vertices if self._skin is None else self._skin.apply(vertices)
        return np.concatenate([points, self._rollout.controllers])
