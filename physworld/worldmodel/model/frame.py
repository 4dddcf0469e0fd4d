"""The grip's frame: a step seen from where the grips are and how they are turned, in free fall.

    y^s = Rᵀ (x^s - c̄^{t+1} - ½ g ((s - t) dt)²)        s = t-h … t+1, one R for the whole step
    R   = polar(A + cof A / |A|),   A = Σ_k (c_k^{t+1} - c̄^{t+1}) shape_kᵀ / Σ_k |shape_k|²

A step in world axes has to learn what each turn of the grips does to the body, and a turn that no demonstration
showed is extrapolated. R is fixed during a step, so that y is an inertial frame: nothing of the mechanics changes
in it, no centrifugal force has to be learned, and a turned body looks as the unturned one does. What does change is
the direction of gravity. It would be an input of its own; but a frame that falls freely has none (the principle of
equivalence): there the grips accelerate against it, and their path already is an input of prior and network. So
nothing of theirs changes, neither a tensor nor an equation: the step is ŷ = step(y), and x^{t+1} = R ŷ^{t+1} +
c̄^{t+1} + ½ g dt².

``shape``: control vertices around their mean, as the episodes start. cof A, the matrix of cofactors, stands in for
the third direction of points in a plane. The polar factor is found by Newton's iteration with Higham's scaling
(SIAM J. Sci. Stat. Comput. 7, 1986), the same ``NEWTON`` rounds in every form of the step but the client's, which
takes a singular value decomposition. Where the points lie on a line along u, no turn about it shows; R is then the
least turn that takes u to d = A u / |A u|, with k = u × d and [k] its matrix of the cross product:

    R   = I + [k] + [k]² / (1 + u · d)

Scenes with a ground have no such frame: what a body touches does not turn with its grips.

Tensors: graph.frame_shape (C, 3) [m], graph.frame_fall (3,): ½ g dt² [m], graph.frame_line (3,): u, 0 for points in
a plane or in space.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array

ON_A_LINE = 1e-3  # second over first singular value of the shape: below it the points lie on a line
NEWTON = 12
OPPOSITE = 1e-3  # least 1 + u · d: a line that is turned round has no least turn

Turn = tuple[Tensor, Tensor]
"""R (B, 3, 3) and c̄ (B, 3) of a step."""


@dataclass(frozen=True)
class GripFrame:
    """``shape`` (C, 3) [m]; ``fall`` (3,): ½ g dt² [m]; ``line`` (3,): u, or 0."""

    shape: Array
    fall: Array
    line: Array
    _tensors: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor, Tensor]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    @property
    def shape_square(self) -> float:
        """Σ |shape|² [m²]."""
        return float((self.shape**2).sum())

    def tensors(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``shape``, ``fall`` and ``line`` of the kind of ``like``: copied to its device once."""
        key, values = (like.device, like.dtype), (self.shape, self.fall, self.line)
        if torch.compiler.is_exporting():  # what is exported holds its constants itself
            shape, fall, line = (like.new_tensor(value) for value in values)
            return shape, fall, line
        if key not in self._tensors:
            with torch.inference_mode(False):  # so that gradients may be taken with them
                shape, fall, line = (like.new_tensor(value) for value in values)
            self._tensors[key] = shape, fall, line
        return self._tensors[key]


def grip_frame(controls: Array, gravity_m_s2: Array, dt_s: float) -> GripFrame | None:
    """The frame of control vertices (C, 3) [m] as the episodes start; None for fewer than two places."""
    shape = np.asarray(controls, dtype=np.float64) - np.mean(controls, axis=0)
    if len(shape) < 2 or not np.any(shape):
        return None
    _, sizes, directions = np.linalg.svd(shape, full_matrices=False)
    line = directions[0] if sizes[1] < ON_A_LINE * sizes[0] else np.zeros(3)
    return GripFrame(shape, 0.5 * np.asarray(gravity_m_s2, dtype=np.float64) * dt_s**2, line)


def turn_of(frame: GripFrame, controls: Tensor) -> Turn:
    """R (B, 3, 3) and c̄ (B, 3) of control vertices (C, B, 3)."""
    shape, _, line = frame.tensors(controls)
    centre = controls.mean(dim=0)
    arms = controls - centre
    seen = torch.einsum("cbi,cj->bij", arms, shape) / frame.shape_square
    if np.any(frame.line):
        return _least_turn(seen, line), centre
    size = torch.linalg.vector_norm(seen, dim=(1, 2), keepdim=True)
    return polar(seen + cofactors(seen) / size), centre


def turns_ahead(frame: GripFrame | None, driven: Tensor) -> list[Turn | None]:
    """R and c̄ of every step of control vertices (T, C, B, 3), in one go; of no frame None each."""
    if frame is None:
        return [None] * len(driven)
    steps, controls, batch, _ = driven.shape
    rotation, centre = turn_of(frame, driven.transpose(0, 1).reshape(controls, steps * batch, 3))
    pairs = zip(rotation.reshape(steps, batch, 3, 3), centre.reshape(steps, batch, 3), strict=True)
    return list(pairs)


def turns_of(frame: GripFrame, controls: Array) -> Array:
    """R of control vertices (T, C, 3) at every frame, (T, 3, 3), in double precision."""
    places = torch.as_tensor(np.asarray(controls, dtype=np.float64).transpose(1, 0, 2).copy())
    found: Array = turn_of(frame, places)[0].numpy()
    return found


def _least_turn(seen: Tensor, line: Tensor) -> Tensor:
    """The least turns (B, 3, 3) that take ``line`` (3,) to where A (B, 3, 3) takes it."""
    onto = seen @ line
    onto = onto / torch.linalg.vector_norm(onto, dim=1, keepdim=True)
    x, y, z = _cross(line.expand_as(onto), onto).unbind(dim=1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=1).reshape(-1, 3, 3)
    near = (1.0 + onto @ line).clamp(min=OPPOSITE)
    turned: Tensor = (
        torch.eye(3, dtype=seen.dtype, device=seen.device) + cross + cross @ cross / near[:, None, None]
    )
    return turned


def polar(matrices: Tensor) -> Tensor:
    """The orthogonal factor of (B, 3, 3), for determinants above 0 a rotation."""
    x = matrices
    for _ in range(NEWTON):
        adjugate = cofactors(x)
        inverse = adjugate / (x[:, :1] * adjugate[:, :1]).sum(dim=(1, 2), keepdim=True)  # transposed
        own = torch.linalg.vector_norm(x, dim=(1, 2), keepdim=True)
        scale = (torch.linalg.vector_norm(inverse, dim=(1, 2), keepdim=True) / own).sqrt()
        x = 0.5 * (scale * x + inverse / scale)
    return x


def cofactors(matrices: Tensor) -> Tensor:
    """cof M = det(M) M⁻ᵀ of (B, 3, 3), also where M has no inverse: rows are cross products of M's rows."""
    first, second, third = matrices.unbind(dim=1)
    return torch.stack([_cross(second, third), _cross(third, first), _cross(first, second)], dim=1)


def _cross(left: Tensor, right: Tensor) -> Tensor:
    """Of (B, 3), in operations that every exporter knows."""
    a, b = left.unbind(dim=1), right.unbind(dim=1)
    parts = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    return torch.stack(parts, dim=1)


def enter(
    frame: GripFrame, window: Tensor, control_next: Tensor, turn: Turn | None = None
) -> tuple[Turn, Tensor, Tensor]:
    """A window and the control vertices in the frame of that moment: (R, c̄), (h+1, V, B, 3) and (C, B, 3).

    Args:
        frame: which control vertices span it, and how far gravity falls in a tick.
        window: positions at t - h … t (h+1, V, B, 3) [m], world axes.
        control_next: control vertices at t + 1 (C, B, 3) [m], world axes.
        turn: R and c̄ of ``control_next``, where they are known (:func:`turns_ahead`).
    """
    rotation, centre = turn or turn_of(frame, control_next)
    ticks = torch.arange(1 - len(window), 1, dtype=window.dtype, device=window.device)
    fall = frame.tensors(window)[1]
    fallen = (ticks.square()[:, None] * fall)[:, None, None]
    local = torch.einsum("svbi,bij->svbj", window - centre - fallen, rotation)
    ahead = torch.einsum("cbi,bij->cbj", control_next - centre - fall, rotation)
    return (rotation, centre), local, ahead


def leave(frame: GripFrame, turn: Turn, ahead: Tensor) -> Tensor:
    """x^{t+1} of ŷ^{t+1} (n, B, 3)."""
    rotation, centre = turn
    return torch.einsum("vbj,bij->vbi", ahead, rotation) + centre + frame.tensors(ahead)[1]
