"""The chain prior's step in torch: training, fine-tuning, ``torch.export`` and ONNX. Tensors ``prior.*``.

``physworld.worldmodel.priors.chain`` has the equations and the legend. On a CPU in single precision the flow over a
tick is native (``chain_native``), elsewhere and while a program is exported it is plain torch. Gradients go to places
and Φ; through the native flow they do not go to the control vertices, which are data.

Legend: B batch, M = 2 B: every sequence with its speed and with the opposite one.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch
from torch import Tensor, nn

from physworld.worldmodel.model.inertia import one_step_residual
from physworld.worldmodel.native.chain_native import NativeFlow
from physworld.worldmodel.priors.chain import CALMINGS, ChainPrior

LEAN_FLOOR = 1e-6  # 1 + cosine of a grip's turn; near 180 degrees the least rotation is not determined
_LENGTH_FLOOR_M2 = 1e-24


class ChainStep(nn.Module):
    """x̂^{t+1} of the object vertices; buffers are the fields of :class:`ChainPrior`."""

    spread: Tensor
    read: Tensor
    hold: Tensor
    member: Tensor
    offset: Tensor
    anchor: Tensor
    first: Tensor
    second: Tensor
    axis: Tensor
    markers: Tensor
    length: Tensor
    pull: Tensor
    mass: Tensor
    curve: Tensor
    bend: Tensor
    dash: Tensor
    natural: Tensor
    carry: Tensor
    normal: Tensor
    twist: Tensor
    between: Tensor
    keep: Tensor
    calm: Tensor
    smooth: Tensor
    slack: Tensor
    share: Tensor
    reach: Tensor
    gravity: Tensor
    substeps: Tensor
    _differ: Tensor
    _free: Tensor
    _lightness: Tensor

    def __init__(self, prior: ChainPrior, history: int) -> None:
        super().__init__()
        self.history = history
        for item in fields(ChainPrior):
            if item.name != "substeps":
                value = torch.as_tensor(np.asarray(getattr(prior, item.name)), dtype=torch.float32)
                self.register_buffer(item.name, value)
        self.register_buffer("substeps", torch.tensor([prior.substeps], dtype=torch.int64))
        count = len(prior.mass)
        self.prior, self.native = prior, NativeFlow(prior, history)
        self._counts, self._markers = (count - 1, count - 2), [int(number) for number in prior.markers]
        self._ends = [(int(segment), int(grip)) for segment, grip in prior.carry]
        self.curved = bool(np.any(prior.natural))
        differ = torch.as_tensor(np.diff(np.eye(count), axis=0), dtype=torch.float32)
        free = (self.member.sum(dim=1) == 0).float()
        for name, value in {
            "_differ": torch.cat([differ, self.curve]),
            "_free": free[:, None, None],
            "_lightness": (free / self.mass)[:, None],
        }.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, window: Tensor, control_next: Tensor, phi: Tensor) -> Tensor:
        """x̂^{t+1} (n, B, 3) from x^{t-h} … x^t (h+1, V, B, 3), c^{t+1} (C, B, 3) and Φ (n, B, 2)."""
        n, batch, known = self.spread.shape[0], window.shape[2], min(self.history, 2) + 1
        latest = window[-known:].flip(0).transpose(0, 1).flatten(1, 2)  # (V, known B, 3), newest first
        led = self.driven(torch.cat([latest[n:], control_next], dim=1))  # of all frames at once
        places = self._nodes(latest[:n], led[:, : known * batch])
        here, behind, ahead = led[:, :batch], led[:, batch : 2 * batch], led[:, known * batch :]
        now, before = places[:, :batch], places[:, batch : 2 * batch]
        speed = now - before
        if known > 2:
            speed = 1.5 * speed - 0.5 * (before - places[:, 2 * batch :])
        speed = self._free * self._rigid(now, _times(self.smooth, speed))
        slope, turn = 0.5 * (ahead - behind), ahead - 2.0 * here + behind
        pull, bend, ease = self._moduli(phi)
        push = self._steady(now, window[-1, n:], bend) if self.curved else torch.zeros_like(now)
        moved = self._flow(
            now.repeat(1, 2, 1),
            torch.cat([speed, -speed], dim=1),
            here.repeat(1, 2, 1),
            torch.cat([slope, -slope], dim=1),
            turn.repeat(1, 2, 1),
            *(modulus.repeat(1, 2)[..., None] for modulus in (pull, bend, ease)),
            push.repeat(1, 2, 1),
        )
        even = 0.5 * (moved[:, :batch] + moved[:, batch:])
        past = self._free * before + behind
        return _times(self.spread, even + _times(self.keep, self._rigid(even, even - past)))

    def flow(
        self,
        place: Tensor,
        velocity: Tensor,
        here: Tensor,
        slope: Tensor,
        turn: Tensor,
        pull: Tensor,
        bend: Tensor,
        ease: Tensor,
        push: Tensor,
    ) -> Tensor:
        """Nodes (K, M, 3) [m] after a tick, in plain torch.

        The driven nodes are at here + s slope + s²/2 turn, s from 0 to 1.

        Args:
            place: of the nodes (K, M, 3) [m].
            velocity: in metres a tick (K, M, 3).
            here: of the driven nodes (K, M, 3) [m].
            slope: their first derivative to the share of a tick (K, M, 3) [m].
            turn: their second one (K, M, 3) [m].
            pull: (wave speed times tick)² over the rest length of the segments (K-1, M, 1) [m].
            bend: of the joints (K-2, M, 1).
            ease: inverse of the nodes' relative mass, 0 for driven ones (K, M, 1).
            push: force on the nodes that stays through the tick, per density (K, M, 3).
        """
        substeps, every = self.prior.substeps, self.prior.substeps // CALMINGS
        step = 1.0 / substeps
        place, move, here, slope, turn = (
            values.permute(2, 0, 1) for values in (place, step * velocity, here, slope, turn)
        )  # (3, K, M): a matrix times it is one operation
        pull, bend, ease = pull[..., 0], bend[..., 0], step**2 * ease[..., 0]
        weight = step**2 * (self._free * self.gravity).permute(2, 0, 1) + ease * push.permute(2, 0, 1)
        tense, dash, before = pull * self.length[:, None], self.dash[:, None] * substeps, None
        still, back = 1.0 - self._free[..., 0], -self._differ.T
        times = step * torch.arange(substeps + 1, dtype=place.dtype, device=place.device)[:, None, None, None]
        led = torch.diff(here + times * (slope + 0.5 * times * turn), dim=0)
        for substep in range(substeps):
            pulled, bent = (self._differ @ place).split(self._counts, dim=1)  # type: ignore[no-untyped-call]  # torch's has no types
            size = torch.sqrt(pulled.square().sum(dim=0) + _LENGTH_FLOOR_M2)
            tension = -tense if before is None else dash * (size - before) - tense
            before = size
            force = torch.cat([pulled * (pull + tension / size), bent * bend], dim=1)
            move = move + ((back @ force) * ease + weight)
            if substep % every == every - 1:
                now = step * (substep + 1)
                move = self._free[..., 0] * (self.calm @ (move + step * still * (slope + now * turn)))
            place = place + move + led[substep]
        return place.permute(1, 2, 0)

    def driven(self, controls: Tensor) -> Tensor:
        """Places of the driven nodes from control vertices (C, B, 3), (K, B, 3); 0 of the free ones."""
        places = controls.new_zeros(len(self.mass), controls.shape[1], 3)
        for grip, markers in enumerate(self._markers):
            offset = self.offset[:, None].expand_as(places)
            if markers > 1:
                offset = self._turned(grip, markers, controls, offset)
            centre = torch.tensordot(self.anchor[grip], controls, dims=1)
            places = places + self.member[:, grip, None, None] * (centre + offset)
        return places

    def nodes_and_controls(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Nodes (K, B, 3) and control vertices (C, B, 3) of all vertices of a frame (V, B, 3) [m]."""
        objects, controls = vertices.split([len(self.spread), len(vertices) - len(self.spread)])  # type: ignore[no-untyped-call]  # torch's has no types
        return self._nodes(objects, self.driven(controls)), controls

    def frames(self, places: Tensor, controls: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """t_j and d_j (K-1, B, 3), carried from the first end and turned evenly, and the angle at the second end [rad].

        Args:
            places: of the nodes (K, B, 3) [m].
            controls: control vertices (C, B, 3) [m].

        The angle (B,) is the one before ``twist`` is taken off, 0 with one end.
        """
        along = _unit(_times(self._differ[: self._counts[0]], places))
        (first, grip), (last, other) = self._ends
        start = _across(self._fixed(grip, controls, self.normal[0]), along[first])
        ahead, behind = _carried(along[first:], start), _carried(along[: first + 1].flip(0), start)
        across = torch.cat([behind.flip(0)[:-1], ahead])
        if grip == other:
            return along, across, along.new_zeros(along.shape[1])
        end = _across(self._fixed(other, controls, self.normal[1]), along[last])
        beside = torch.linalg.cross(along[last], across[last])
        angle = torch.atan2((end * beside).sum(dim=-1), (end * across[last]).sum(dim=-1))
        off = angle - self.twist
        off = self.between[:, None] * torch.atan2(torch.sin(off), torch.cos(off))
        turned = torch.cos(off)[..., None] * across
        return along, turned + torch.sin(off)[..., None] * torch.linalg.cross(along, across), angle

    def residual(self, positions: Tensor, phi: Tensor) -> Tensor:
        """What the prior leaves of each step of a track (T, V, 3) with Φ (n, 2): x^{t+1} - x̂^{t+1}, (n, T-1-h, 3)."""
        return one_step_residual(self, positions, phi, self.spread.shape[0], self.history)

    def _flow(self, *start: Tensor) -> Tensor:
        native = start[0].device.type == "cpu" and start[0].dtype == torch.float32
        if native and not torch.compiler.is_exporting():
            return self.native(*start)
        return self.flow(*start)

    def _nodes(self, vertices: Tensor, driven: Tensor) -> Tensor:
        """Nodes (K, B, 3) of object vertices (n, B, 3) whose driven nodes are known."""
        return _times(self.read, vertices) + _times(self.hold, driven)

    def _moduli(self, phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """pull (K-1, B), bend (K-2, B), ease (K, B) of Φ (n, B, 2)."""
        stiff, heavy = (
            torch.minimum(torch.maximum(self.share @ phi[..., k], -self.reach[k]), self.reach[k])
            for k in range(2)
        )
        pull = self.pull[:, None] * torch.exp(0.5 * (stiff[1:] + stiff[:-1]))
        return pull, self.bend[:, None] * torch.exp(stiff[1:-1]), self._lightness * torch.exp(-heavy)

    def _steady(self, places: Tensor, controls: Tensor, bend: Tensor) -> Tensor:
        """Force of the natural curvature on the nodes (K, B, 3), from places, control vertices and bend (K-2, B)."""
        along, across, _ = self.frames(places, controls)
        beside = torch.linalg.cross(along, across)
        one, two = 0.5 * (across[1:] + across[:-1]), 0.5 * (beside[1:] + beside[:-1])
        natural = self.natural[:, None, :1] * one + self.natural[:, None, 1:] * two
        return _times(self.curve.T, bend[..., None] * natural)

    def _fixed(self, grip: int, controls: Tensor, vector: Tensor) -> Tensor:
        """A vector (3,) of a grip's frame in the world's axes, (B, 3)."""
        own = vector.expand(1, controls.shape[1], 3)
        markers = self._markers[grip]
        return (own if markers == 1 else self._turned(grip, markers, controls, own))[0]

    def _turned(self, grip: int, markers: int, controls: Tensor, offset: Tensor) -> Tensor:
        """Offsets (·, B, 3) in the grip's frame, turned into the world's axes."""
        along = _unit(torch.tensordot(self.first[grip], controls, dims=1))
        if markers == 2:
            axis = torch.linalg.cross(self.axis[grip].expand_as(along), along).expand_as(offset)
            once = torch.linalg.cross(axis, offset)
            lean = 1.0 + (along * self.axis[grip]).sum(dim=-1, keepdim=True)
            turned: Tensor = offset + once + torch.linalg.cross(axis, once) / lean.clamp(min=LEAN_FLOOR)
            return turned
        normal = _unit(torch.linalg.cross(along, torch.tensordot(self.second[grip], controls, dims=1)))
        across = torch.linalg.cross(normal, along)
        turned = offset[..., :1] * along + offset[..., 1:2] * across + offset[..., 2:] * normal
        return turned

    def _rigid(self, place: Tensor, change: Tensor) -> Tensor:
        """``change`` (K, B, 3) of ``place`` without what lengthens segments."""
        differ = self._differ[: self._counts[0]]
        along = _unit(_times(differ, place))
        stretch = (along * _times(differ, change)).sum(dim=-1, keepdim=True)
        back = _times(differ.T, along * _times(self.slack, stretch))
        return change - self._lightness[..., None] * back


def _carried(along: Tensor, start: Tensor) -> Tensor:
    """``start`` (B, 3) across the first of some segments, carried by least rotations along all (S, B, 3)."""
    one, following = along[:-1], along[1:]
    axis, lean = torch.linalg.cross(one, following), 1.0 + (one * following).sum(dim=-1, keepdim=True)
    x, y, z = axis.unbind(dim=-1)
    zero = torch.zeros_like(x)
    across = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*x.shape, 3, 3)
    turn = torch.eye(3, dtype=along.dtype, device=along.device) + across
    turn = turn + across @ across / lean.clamp(min=LEAN_FLOOR)[..., None]
    span = 1
    while span < len(turn):  # products of all turns up to each, by doubling: a few large operations
        turn = torch.cat([turn[:span], turn[span:] @ turn[:-span]])
        span *= 2
    return torch.cat([start[None], (turn @ start[..., None])[..., 0]])


def _across(vector: Tensor, along: Tensor) -> Tensor:
    """The unit vector of ``vector`` without its part along a tangent, (B, 3)."""
    return _unit(vector - (vector * along).sum(dim=-1, keepdim=True) * along)


def _unit(vector: Tensor) -> Tensor:
    unit: Tensor = vector / torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return unit


def _times(matrix: Tensor, values: Tensor) -> Tensor:
    """(R, K) times (K, B, ·)."""
    product = matrix @ values.flatten(1)
    places: Tensor = product.unflatten(1, values.shape[1:])  # type: ignore[no-untyped-call]  # torch's has no types
    return places
