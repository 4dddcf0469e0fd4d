"""NEAR edges of the current shape: who is nearest now, and what an edge between any two vertices says of its rest.

Every object vertex i hears the k = ``GraphSpec.current_neighbours`` object vertices j that are nearest at frame t,
among those with |x_j - x_i| ≤ d_e (``edge_radius_m``); of equal distances the lower index goes first. The senders of a
receiver come in ascending order, so that sums do not depend on which of them is the nearest. Distances are single
precision; at a tie, or at the radius, the last digit of a place decides. Gradients do not see that the edges change.

Two vertices that meet may be far apart at rest. So that an edge between them says no more than "beyond all material
edges", its strain s = (x_j - rest_j) - (x_i - rest_i) and its rest length are cut off:

    s̄ = s · min(1, d_e / |s|),    |r̄_rest| = min(|rest_j - rest_i|, 2 d_e)

They stand in the features of ``physworld.worldmodel.model.model`` in the places of r^t - r_rest and |r_rest|.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.worldmodel.model.features import cut_rest_length, cut_strain
from physworld.worldmodel.model.graph import EDGE_KINDS
from physworld.worldmodel.native.messages import EdgeList, mean_messages, warp_module


def find_nearest(places: Array, most: int, radius_m: float) -> tuple[Array, Array]:
    """Senders (B, n, most) int32, ascending, and how many of them count (B, n) int32; the rest of a row is -1.

    Args:
        places: object vertices [m], (B, n, 3).
        most: nearest of each, itself left out.
        radius_m: d_e.
    """
    batch, n, _ = places.shape
    single = np.ascontiguousarray(places, dtype=np.float32)
    senders = np.full((batch, n, most), -1, dtype=np.int32)
    counts = np.zeros((batch, n), dtype=np.int32)
    room = np.zeros(most + 3 * n, dtype=np.float32)
    addresses = [array.ctypes.data for array in (single, senders, counts, room)]
    inputs = [batch, n, most, float(np.float32(radius_m)), *addresses]
    warp_module().launch(_kernels().nearest, dim=1, inputs=inputs, device="cpu", record_tape=False)
    return senders, counts


def near_ends(places: Array, most: int, radius_m: float) -> tuple[Array, Array, Array]:
    """Batch element, receiver and sender of every NEAR edge of places (B, n, 3), (E,) each, in this order."""
    senders, _ = find_nearest(places, most, radius_m)
    element, receiver, slot = np.nonzero(senders >= 0)
    return element, receiver, senders[element, receiver, slot].astype(np.int64)


class KeptEdges:
    """The COARSE and GRIP edges of B copies of a graph, side by side: vertex v of copy b is v B + b.

    Args:
        edges: of one copy.
        vertices: V, of one copy.
        batch: B.
        device: of the index tensors.
    """

    def __init__(self, edges: EdgeList, vertices: int, batch: int, device: torch.device) -> None:
        element = torch.arange(batch, device=device)
        senders, receivers = (ends.to(device).long() for ends in (edges.senders, edges.receivers))
        receivers = (receivers[:, None] * batch + element).flatten()
        order = torch.argsort(receivers, stable=True)
        self.rows = order // batch
        self.receivers = receivers[order].int()
        self.senders = (senders[:, None] * batch + element).flatten()[order].int()
        self.degree = torch.bincount(receivers, minlength=EDGE_KINDS * vertices * batch)


class CurrentEdges:
    """All edges of a step of B sequences: the NEAR ones of places now, the others as they are kept."""

    def __init__(
        self,
        kept: KeptEdges,
        now: Tensor,
        places: Tensor,
        reference: Tensor,
        kept_offset: Tensor,
        *,
        neighbours: int,
        radius_m: float,
    ) -> None:
        """Find them.

        Args:
            kept: the other edges.
            now: object vertices, (n, B, 3) [m].
            places: all vertices less their reference places [m], (V, B, 3).
            reference: reference places of all vertices [m], (V, 3).
            kept_offset: reference x_sender - x_receiver of the kept edges of one copy [m], (E, 3).
            neighbours: k.
            radius_m: d_e.
        """
        objects, batch = now.shape[:2]
        own = now.detach().permute(1, 0, 2).numpy(force=True)
        searched = find_nearest(own, neighbours, radius_m)
        senders, counts = (torch.from_numpy(found).to(now.device) for found in searched)
        by_receiver = senders.permute(1, 0, 2).long()  # (n, B, k)
        here = by_receiver >= 0
        vertex, element, _ = torch.nonzero(here, as_tuple=True)
        heard = by_receiver[here]
        near_receivers, near_senders = vertex * batch + element, heard * batch + element
        degree = kept.degree.clone()
        degree[: objects * batch] = counts.T.flatten()
        flat = places.flatten(0, 1)
        strain = flat.index_select(0, near_senders) - flat.index_select(0, near_receivers)
        offset = reference[heard] - reference[vertex]
        kept_receivers, kept_senders = (
            ends.long() % flat.shape[0] for ends in (kept.receivers, kept.senders)
        )
        along = flat.index_select(0, kept_senders) - flat.index_select(0, kept_receivers)
        gap = torch.cat([strain + offset, along + kept_offset[kept.rows]])
        self.length = torch.linalg.vector_norm(gap, dim=-1, keepdim=True)
        rest_length = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        self.near = torch.cat(
            [offset, cut_strain(strain, radius_m) - strain, cut_rest_length(rest_length, radius_m)], dim=1
        )
        self.rows = kept.rows
        self.edges = EdgeList(
            torch.cat([degree.new_zeros(1), degree.cumsum(0)]).int(),
            torch.cat([near_senders.int(), kept.senders]),
            torch.cat([near_receivers.int(), kept.receivers]),
            np.zeros(0, dtype=np.int64),
        )

    def means(
        self, heard: Tensor, sent: Tensor, near_table: Tensor, kept_bias: Tensor, weight: Tensor
    ) -> Tensor:
        """Mean messages of every vertex, by kind, (K, V, B, H).

        Args:
            heard: what receivers add (K, V, B, H).
            sent: what senders add (K, V, B, H).
            near_table: the layer's map of the seven features of a NEAR edge (7, H).
            kept_bias: the layer's terms of the kept edges (E, H).
            weight: of the edge's present length (K, H).
        """
        bias = torch.cat([self.near @ near_table, kept_bias[self.rows]])
        hears, says = (side.flatten(1, 2)[:, :, None] for side in (heard, sent))
        return mean_messages(self.edges, hears, says, bias, self.length, weight).view_as(heard)


@cache
def _kernels() -> ModuleType:
    from physworld.worldmodel.native import nearest_kernels

    return nearest_kernels
