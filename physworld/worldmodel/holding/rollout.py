"""Rollouts in which grips let go and take hold again: one world model for each set of grips that hold.

The state of a world model is its window, h + 1 frames of the object vertices. The vertices are the same particles
whatever grips hold, since they are a farthest-point sampling of the same body: so at a change of the set the next
model goes on from the last h + 1 frames of the one before, and what was learned of either, its engine and its exports
stay as they are. Grips that close do it on the material where it was predicted
(``physworld.worldmodel.holding.taking``).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from physworld.arrays import Array
from physworld.worldmodel.errors import ControlsInvalid, GraphInvalid, VersionUnreadable
from physworld.worldmodel.holding.spans import Grips, Span, every_grip, spans_of
from physworld.worldmodel.holding.taking import taken_hold, vertices_near
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.rollout import rollout_batch


@dataclass(frozen=True)
class HeldModels:
    """World models of one body by the grips that hold.

    Attributes:
        members: the models; all have the same vertices, clock and history.
        groups: controllers of each grip, index arrays (twin's ``controller_groups``).

    Raises:
        GraphInvalid: members that do not belong together, with their numbers.
    """

    members: Mapping[Grips, WorldModel]
    groups: tuple[Array, ...]

    def __post_init__(self) -> None:
        if not self.members:
            raise GraphInvalid("there is no world model, for none of the sets of grips")
        first = next(iter(self.members.values()))
        for grips, model in self.members.items():
            spec = model.spec
            if not grips or not set(grips) <= set(range(len(self.groups))):
                raise GraphInvalid(f"a world model of grips {list(grips)}, of {len(self.groups)} from 0 on")
            opened = [self.groups[g] for g in range(len(self.groups)) if g not in grips]
            if opened and np.isin(spec.control_index, np.concatenate(opened)).any():
                raise GraphInvalid(f"the world model of grips {list(grips)} has control vertices of others")
            if not np.array_equal(spec.particle_index, first.spec.particle_index):
                raise GraphInvalid(
                    f"the world model of grips {list(grips)} has other vertices: {spec.object_count}, the first one "
                    f"{first.spec.object_count}"
                )
            clock = (spec.dt_s, model.config.history)
            if clock != (first.spec.dt_s, first.config.history):
                raise GraphInvalid(
                    f"the world model of grips {list(grips)} has steps of {clock[0]:.6g} s and history {clock[1]}, the "
                    f"first one {first.spec.dt_s:.6g} s and {first.config.history}"
                )

    @cached_property
    def engines(self) -> dict[Grips, RolloutEngine]:
        """The members' weights, prepared once for every rollout that follows."""
        return {grips: RolloutEngine(model) for grips, model in self.members.items()}

    def rollout(
        self,
        history: Array,
        controllers: Array,
        holding: Array,
        phi: Array | Mapping[Grips, Array],
        *,
        take_hold: bool = True,
    ) -> Array:
        """Object vertices over time [m], (T, n, 3) float64.

        Args:
            history: object vertices at frames 0 … h of the clock [m], (h+1, n, 3); the result starts so. At frame 0
                every grip stands to the material that it holds, or held, as in the demonstrations at their start.
            controllers: all controllers at frames 0 … T-1 [m], (T, K, 3): those of a grip where its hand is, which
                counts while it holds.
            holding: (T, G): 1 where a grip holds from that frame to the next one.
            phi: log property ratios (n, 2), for all members or one for each.
            take_hold: whether a grip that closes holds the material where it was predicted; otherwise it is as if it
                were where the hand's path expects it. One that is open at frame 0 held nothing before: it is where its
                hand is.

        Raises:
            ControlsInvalid: ``holding`` of another shape, or grips hold that no member is for.
            GraphInvalid: other arrays of other shapes, values that are not finite, or a member that left the numbers
                before another one takes over.
        """
        hand = np.asarray(controllers, dtype=np.float64)
        spans = self._spans(history, hand, holding)
        window, driven = len(history), hand.copy()
        path = np.empty((len(hand), *history.shape[1:]))
        path[:window] = history
        never = {g for g in range(len(self.groups)) if spans and g not in spans[0].grips}
        opened: dict[int, int] = {}
        for span in spans:
            if not np.isfinite(path[: max(span.first + 1, window)]).all():
                raise GraphInvalid(
                    f"the prediction left the numbers before frame {span.first}, from which on the grips "
                    f"{list(span.grips)} hold"
                )
            if take_hold:
                for grip in sorted((opened.keys() & set(span.grips)) - never):
                    self._close(grip, opened[grip], path[: span.first + 1], hand, driven)
            opened = {g: opened.get(g, span.first) for g in range(len(self.groups)) if g not in span.grips}
            known = max(span.first + 1, window)
            if span.end < known:
                continue
            past = slice(known - window, known)
            rolled = rollout_batch(
                self.engines[span.grips],
                self.members[span.grips].spec,
                path[past],
                driven[None, past.start : span.end + 1],
                phi[span.grips] if isinstance(phi, Mapping) else phi,
            )
            path[known : span.end + 1] = rolled[0, window:]
        return path

    def _spans(self, history: Array, hand: Array, holding: Array) -> list[Span]:
        """The spans of ``holding``. Raises what :meth:`rollout` says of its arrays."""
        model = next(iter(self.members.values()))
        frames, count, window = len(hand), len(self.groups), model.config.history + 1
        if np.shape(holding) != (frames, count):
            raise ControlsInvalid(
                f"holding of shape {np.shape(holding)} for {frames} frames of {count} grips", "holding"
            )
        expected = (window, model.spec.object_count, 3)
        most = max(int(group.max(initial=0)) for group in self.groups)
        if history.shape != expected or frames < window or hand.shape[1] <= most:
            raise GraphInvalid(
                f"history of shape {history.shape} and controllers of {hand.shape}, not {expected} and at least "
                f"{(window, most + 1, 3)}"
            )
        broken = sum(np.count_nonzero(~np.isfinite(part)) for part in (hand, history))
        if broken:
            raise GraphInvalid(f"{broken} values of controllers and history are not finite")
        spans = spans_of(holding)
        for span in spans:
            if span.grips not in self.members:
                raise ControlsInvalid(_unknown(span, self.members), "holding")
        return spans

    def _close(self, grip: int, opened: int, path: Array, hand: Array, driven: Array) -> None:
        """Let a grip take hold at the last frame of ``path`` (S, n, 3): ``driven`` (T, K, 3) is changed in place."""
        spec, own = next(iter(self.members.values())).spec, self.groups[grip]
        near = vertices_near(spec, path[0], hand[0, own])
        driven[opened + 1 :, own] = taken_hold(path[:, near], hand[:, own], opened)


@dataclass(frozen=True)
class HeldVersions:
    """Published versions of one body, one for each set of grips, as one model:

        versions = [PublishedModel.from_card(tensors, card) for tensors, card in downloaded]
        holding[20:50, 1] = 0                       # the second grip lets go, and takes hold again
        vertices = HeldVersions.of(versions).rollout(controllers, holding)

    Attributes:
        models: their networks.
        phi: the fine-tuned Φ of each, (n, 2).
        start_history: object vertices at the recording's first ticks [m], (h+1, n, 3).
    """

    models: HeldModels
    phi: Mapping[Grips, Array]
    start_history: Array

    @classmethod
    def of(cls, versions: Sequence[PublishedModel]) -> HeldVersions:
        """Versions by the grips that hold in each (``PublishedModel.holding``; None: all of them).

        Raises:
            GraphInvalid: versions that do not belong together, two of the same grips, or none.
        """
        by_grips = {
            every_grip(len(one.grips)) if one.holding is None else one.holding: one for one in versions
        }
        if len(by_grips) < len(versions):
            raise GraphInvalid(f"{len(versions)} versions are of {len(by_grips)} sets of grips")
        named = {one.grips for one in versions}
        if len(named) > 1:
            raise GraphInvalid(f"the versions name {len(named)} ways in which controllers make grips")
        groups = tuple(np.array(own, dtype=np.int64) for grips in named for own in grips)
        models = HeldModels({grips: one.model for grips, one in by_grips.items()}, groups)
        return cls(models, {grips: one.phi for grips, one in by_grips.items()}, versions[0].start_history)

    @classmethod
    def published(cls, folder: Path) -> HeldVersions:
        """What a training of a recording in which grips let go published.

        Args:
            folder: of a downloaded version: ``card.json``, ``model.safetensors`` and the files of ``card["held"]``.

        Raises:
            VersionUnreadable: a part of another layout.
        """
        card = json.loads((folder / "card.json").read_text())
        return cls.of_one(
            with_others(load_file(folder / "model.safetensors"), card, lambda name: load_file(folder / name))
        )

    @classmethod
    def of_one(cls, version: PublishedModel) -> HeldVersions:
        """A version with the others that were published with it. Raises what :meth:`of` does."""
        return cls.of([version, *version.others])

    def rollout(
        self, controllers: Array, holding: Array, *, history: Array | None = None, take_hold: bool = True
    ) -> Array:
        """Object vertices (T, n, 3) [m]; see :meth:`HeldModels.rollout`.

        Args:
            controllers: (T, K, 3) [m] at ticks from the start's first one.
            holding: (T, G).
            history: object vertices at the first ticks [m], (h+1, n, 3); by default the recording's.
            take_hold: whether a grip that closes holds the material where it was predicted.
        """
        start = self.start_history if history is None else history
        return self.models.rollout(start, controllers, holding, self.phi, take_hold=take_hold)


def with_others(
    tensors: dict[str, Array], card: dict[str, Any], read: Callable[[str], dict[str, Array]]
) -> PublishedModel:
    """A version with the models for other sets of grips that its card names (``held``).

    Args:
        tensors: of ``model.safetensors``.
        card: of ``card.json``.
        read: gives the tensors of another file of the version by its name.

    Raises:
        VersionUnreadable: a part of another layout.
    """
    version = PublishedModel.from_card(tensors, card)
    others = []
    for number, part in enumerate(card.get("held", [])):
        if part.get("file") != f"held_{number}.safetensors" or "architecture" not in part:
            raise VersionUnreadable(
                f"its card names {part.get('file')!r} as the model of other grips {number}"
            )
        try:
            others.append(PublishedModel.from_tensors(read(part["file"]), part["architecture"]))
        except (KeyError, FileNotFoundError) as error:
            raise VersionUnreadable(f"it lacks {part['file']}") from error
    return replace(version, others=tuple(others))


def _unknown(span: Span, members: Mapping[Grips, WorldModel]) -> str:
    """What is said of a set that no member is for."""
    when = f"from frame {span.first} to {span.end}"
    if not span.grips:
        return f"no grip holds {when}: a world model follows grips, so at least one has to hold"
    known = ", ".join(str(list(grips)) for grips in members)
    return f"grips {list(span.grips)} hold {when}; there are world models of {known}"
