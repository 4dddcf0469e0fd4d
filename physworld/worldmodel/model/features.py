"""What the network sees of vertices and edges, and the scales that its inputs are divided by.

The features are those of ``physworld.worldmodel.model.model``, which has their order and the legend. The torch network
takes its vertex features from here, the exported step (``physworld.worldmodel.export``) both kinds; the network's own
form of the edge features is split into terms per vertex and per edge (``WorldModel.edge_constants``).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from physworld.worldmodel.model.graph import NEAR, GraphSpec

REST_RADII = 2.0  # longest rest length that a NEAR edge found at a step tells, in edge radii


@dataclass(frozen=True)
class Normalisation:
    """Root-mean-square scales of the training data, in metres (``properties``: of the logarithms).

    Attributes:
        velocity: of vertex displacements per step.
        change: of what the prior leaves, x^{t+1} - x̂^{t+1}.
        relative: of relative displacements per step along edges, by edge kind.
        strain: of r - r_rest along edges, by edge kind.
        stretch: of |r| - |r_rest| along edges, by edge kind.
        properties: of Φ, (2,), or (2 + m,) with m strengths of effects.
    """

    velocity: float = 1.0
    change: float = 1.0
    relative: tuple[float, float, float] = (1.0, 1.0, 1.0)
    strain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    properties: tuple[float, ...] = (1.0, 1.0)


class Scales(nn.Module):
    """The scales ``norm.*`` as float32 buffers: (1,), by edge kind (3,), by property (2 + m,); ``length`` is d_e."""

    velocity: Tensor
    change: Tensor
    relative: Tensor
    strain: Tensor
    stretch: Tensor
    properties: Tensor
    length: Tensor

    def __init__(self, normalisation: Normalisation, spec: GraphSpec) -> None:
        super().__init__()
        values = {name: (getattr(normalisation, name),) for name in ("velocity", "change")}
        values |= {
            name: getattr(normalisation, name) for name in ("relative", "strain", "stretch", "properties")
        }
        values["length"] = (spec.edge_radius_m,)
        for name, value in values.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32))


def vertex_features(
    window: Tensor, moves: Tensor, ahead: Tensor, phi: Tensor, norm: Scales, *, grounded: bool
) -> Tensor:
    """f_i of every vertex, (V, …, 3h + 5 + columns of Φ, one more with a ground); … may hold a batch.

    Args:
        window: x^{t-h} … x^t [m], (h+1, V, …, 3).
        moves: displacements per step, the newest first [m], (h, V, …, 3).
        ahead: x̂^{t+1} of the object vertices and c^{t+1} [m], (V, …, 3).
        phi: Φ of the object vertices, (n, …, columns).
        norm: the scales.
        grounded: whether the height above the ground is a feature.
    """
    moves = moves / norm.velocity
    batch = window.shape[2:-1]
    objects, controls = phi.shape[0], window.shape[1] - phi.shape[0]
    of_object = torch.cat([window.new_ones(objects, *batch, 1), window.new_zeros(controls, *batch, 1)])
    properties = torch.cat([phi / norm.properties, phi.new_zeros(controls, *batch, phi.shape[-1])])
    parts = [
        *moves.unbind(0),
        (ahead - window[-1]) / norm.velocity,
        properties,
        of_object,
        1.0 - of_object,
    ]
    if grounded:
        parts.append(torch.clamp(window[-1, ..., 2:] / norm.length, 0.0, 1.0))
    return torch.cat(parts, dim=-1)


def edge_features(
    relative: Tensor, rest: Tensor, kinds: Tensor, norm: Scales, radius_m: float | None
) -> Tensor:
    """e_ij of every edge, (E, …, 3h + 8).

    Args:
        relative: x_sender - x_receiver at t-h … t [m], (h+1, E, …, 3).
        rest: the same undeformed [m], (E, …, 3).
        kinds: NEAR, COARSE or GRIP, (E,).
        norm: the scales.
        radius_m: d_e where the NEAR edges are those of the current shape, so that their features are cut; else None.
    """
    inner = (slice(None), *(None,) * (rest.dim() - 1))
    strain, drift, stretch = (
        scale.index_select(0, kinds)[inner] for scale in (norm.strain, norm.relative, norm.stretch)
    )
    moves = (relative[1:] - relative[:-1]).flip(0) / drift
    length = torch.linalg.vector_norm(relative[-1], dim=-1, keepdim=True)
    rest_length = torch.linalg.vector_norm(rest, dim=-1, keepdim=True)
    strained = relative[-1] - rest
    if radius_m is not None:
        near = (kinds == NEAR)[inner]
        strained = torch.where(near, cut_strain(strained, radius_m), strained)
        rest_length = torch.where(near, cut_rest_length(rest_length, radius_m), rest_length)
    return torch.cat(
        [
            relative[-1] / norm.length,
            strained / strain,
            *moves.unbind(0),
            rest_length / norm.length,
            (length - rest_length) / stretch,
        ],
        dim=-1,
    )


def cut_strain(strain: Tensor, radius: float) -> Tensor:
    """s̄ of s (…, 3) of a NEAR edge found at a step (:mod:`physworld.worldmodel.model.nearest`)."""
    size = torch.linalg.vector_norm(strain, dim=-1, keepdim=True)
    cut: Tensor = strain * (radius / size.clamp(min=radius))
    return cut


def cut_rest_length(rest_length: Tensor, radius: float) -> Tensor:
    """|r̄_rest| of |r_rest| of such an edge."""
    return rest_length.clamp(max=REST_RADII * radius)
