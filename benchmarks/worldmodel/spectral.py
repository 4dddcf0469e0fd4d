"""A graph network whose layers also mix along the graph's own modes: a trial of the study, no part of the product.

U (n, R): the R lowest eigenvectors of the Laplacian of the rest places, mean square 1. In one tick of 1/30 s a bending
wave crosses the body; hops between neighbours carry it slowly, modes at once (graph Fourier layers, as those of the
Fourier neural operator, Li et al. 2021). Beside the messages every layer adds, with H x H matrices W_r of its own,

    U_r W_r (U_r^T h) / n                         to what its update sees,

and the network's output adds a linear map of the body's modes: where they are, their last speeds and changes of speed,
where the control vertices are and how they move, each divided by its size in the episodes. Both begin at 0.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from physworld.worldmodel.dataset import Track
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.features import vertex_features
from physworld.worldmodel.model.frame import turn_of
from physworld.worldmodel.model.graph import EDGE_KINDS, GraphSpec
from physworld.worldmodel.model.model import EdgeConstants, WorldModel
from physworld.worldmodel.model.modes import graph_modes
from physworld.worldmodel.native.messages import as_seen

SMALLEST_M = 1e-8
MEASURED = 24  # episodes that sizes are measured on


class SpectralModel(WorldModel):
    """The network of the module's text; ``tracks`` give the sizes of the modes."""

    waves: Tensor
    middle: Tensor
    place: Tensor
    speed: Tensor
    change: Tensor
    control_middle: Tensor
    control_place: Tensor

    def __init__(self, config: WorldModelConfig, spec: GraphSpec, *rest: Any, tracks: list[Track]) -> None:
        super().__init__(config, spec, *rest[:3])  # without the product's own map of modes
        modes = torch.as_tensor(graph_modes(spec.rest_vertices).T, dtype=torch.float32)
        n, count, h, hidden = spec.object_count, modes.shape[1], config.history, config.hidden
        self.register_buffer("waves", modes)
        self.mix = nn.ParameterList(
            nn.Parameter(torch.zeros(count, hidden, hidden)) for _ in range(config.message_passing_steps)
        )
        inputs = 3 * ((h + 2) * count + (h + 1) * spec.control_count)
        self.linear = nn.Parameter(torch.zeros(inputs, 3 * count))
        measured = [_steps(track.positions, spec, self._reference) for track in tracks[:MEASURED]]
        places, speeds, changes = (torch.cat(parts) for parts in zip(*measured, strict=True))
        for name, values in (("place", places), ("speed", speeds), ("change", changes)):
            own = torch.einsum("tvk,vr->trk", values[:, :n], modes) / n
            if name == "place":
                self.register_buffer("middle", own.mean(dim=0))
                own = own - self.middle
            self.register_buffer(name, own.square().mean(dim=0).sqrt().clamp(min=SMALLEST_M))
        self.register_buffer("control_middle", places[:, n:].mean(dim=0))
        held = (places[:, n:] - self.control_middle).square().mean().sqrt()
        self.register_buffer("control_place", held.clamp(min=SMALLEST_M))

    def forward(
        self, window: Tensor, ahead: Tensor, phi: Tensor, constants: EdgeConstants | None = None
    ) -> Tensor:
        """y (n, B, 3), as :meth:`WorldModel.forward`.

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, B, 3).
            ahead: x̂^{t+1} of the object vertices and c^{t+1} [m], (V, B, 3).
            phi: log property ratios of the object vertices, (n, B, 2).
            constants: ``edge_constants()``, when many steps share the weights.
        """
        constants = constants or self.edge_constants()
        n, modes = self.spec.object_count, self.waves
        moves = (window[1:] - window[:-1]).flip(0)
        grounded = self.spec.ground_height_m is not None
        features = vertex_features(window, moves, ahead, phi, self.norm, grounded=grounded)
        shifted = window[-1] - self._reference[:, None]
        places = torch.cat([shifted, *moves.unbind(0)], dim=-1).flatten(0, 1).expand(EDGE_KINDS, -1, -1)
        mean_of = self._material_means(window[-1], shifted, constants)
        state = self.encoder(features)
        for layer in range(self.config.message_passing_steps):
            placed = torch.bmm(places, constants.position[layer])
            placed = placed.unflatten(1, window.shape[1:3])  # type: ignore[no-untyped-call]  # torch's has no types
            heard, sent = as_seen(self.receive[layer](state), self.send[layer](state), placed)
            inner = self.update_in[layer](torch.cat([state, *mean_of(layer, heard, sent).unbind(0)], dim=-1))
            mixed = torch.bmm(torch.tensordot(modes, state[:n], dims=([0], [0])) / n, self.mix[layer])
            inner = torch.cat([inner[:n] + torch.tensordot(modes, mixed, dims=1), inner[n:]])
            state = state + self.update_out[layer](torch.relu(inner))
        local: Tensor = self.decoder(state[:n]) + self.skip(features[:n])
        return local + self._global(shifted, moves, ahead[:n] - window[-1, :n])

    def _global(self, shifted: Tensor, moves: Tensor, prior: Tensor) -> Tensor:
        """The linear map, (n, B, 3), of displacements (V, B, 3), moves (h, V, B, 3), the prior's move (n, B, 3) [m]."""
        n, modes = self.spec.object_count, self.waves

        def own(values: Tensor, size: Tensor) -> Tensor:
            found = torch.tensordot(modes, values, dims=([0], [0])) / n / size[:, None]
            return found.transpose(0, 1).flatten(1)

        place = torch.tensordot(modes, shifted[:n], dims=([0], [0])) / n - self.middle[:, None]
        controls = (shifted[n:] - self.control_middle[:, None]) / self.control_place
        seen = [
            (place / self.place[:, None]).transpose(0, 1).flatten(1),
            own(moves[0, :n], self.speed),
            *(own(change, self.change) for change in (moves[1:, :n] - moves[:-1, :n]).unbind(0)),
            own(prior, self.speed),
            controls.transpose(0, 1).flatten(1),
            *((move / self.norm.velocity).transpose(0, 1).flatten(1) for move in moves[:, n:].unbind(0)),
        ]
        out = (torch.cat(seen, dim=1) @ self.linear).unflatten(1, (modes.shape[1], 3)) * self.change  # type: ignore[no-untyped-call]
        spread: Tensor = torch.tensordot(modes, out.transpose(0, 1), dims=1) / self.norm.change
        return spread


def spectral(tracks: list[Track]) -> partial[SpectralModel]:
    """What ``train`` builds its network with."""
    return partial(SpectralModel, tracks=tracks)


def _steps(positions: Tensor, spec: GraphSpec, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Displacements, speeds and their changes a tick of a track (T, V, 3), each (T-2, V, 3) in the step's frame [m]."""
    here, change = positions[1:-1], positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    speed = positions[1:-1] - positions[:-2]
    if spec.frame is not None:
        turns, centre = turn_of(spec.frame, positions[2:, spec.object_count :].transpose(0, 1))
        here, speed, change = (here - centre[:, None]) @ turns, speed @ turns, change @ turns
    return here - reference, speed, change
