"""A splat fitted to pictures of one state: Kerbl et al. 2023 with the renderer of the films, on a CPU.

The loss of a picture is 0.8 L1 + 0.2 (1 - SSIM) over the box around the object's pixels, with the object on a
background that changes every step, so that nothing is gained by being transparent; outside of the mask the splat has
to be empty. Pixels there in front of the object show what covers it, and say nothing. Where depth was measured, the
splat's has to agree: one camera alone does not tell how far things are. Adam moves places, scales, rotations,
opacities and colours; there is one colour a Gaussian, which a few cameras do not tell from more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.errors import SplatNotFitted
from physworld.video.blending import Blend, Canvas
from physworld.video.gaussians import SH_DC, Gaussians
from physworld.video.projection import project, tiles
from physworld.video.render import Renderer
from physworld.video.splat_start import SplatView, start_from_depth, start_from_points
from physworld.video.ssim import structural_similarity_of

MARGIN_PX = 12
"""Around the object's pixels, where the splat has to be empty."""
IN_FRONT_M = 0.01
"""A pixel outside of the mask that is so much nearer than the object covers it."""
DEPTH_SCALE_M = 0.01
"""Of the difference of depths, in the loss."""
LEAST_COVERAGE = 0.05
"""Of a pixel whose depth is compared."""
LEAST_OPACITY = 0.01
"""Fainter Gaussians are left out in the end."""

Told = Callable[[int, int, str], None]


@dataclass(frozen=True)
class SplatConfig:
    """Settings.

    Attributes:
        steps: of Adam; views take turns.
        most: Gaussians at most.
        similarity: weight of 1 - SSIM, L1 has the rest.
        depth: weight of the depth's difference in cm, of at most 1.
        place_step: of the extent, falling to a hundredth in the end; Adam's, as are the following.
        scale_step, rotation_step, opacity_step, colour_step: of logarithms, quaternions, logits, harmonics.
        seed: of the backgrounds.
        device: Warp device.

    Raises:
        ValueError: a number of steps or Gaussians below 1, or a weight outside of [0, 1].
    """

    steps: int = 200
    most: int = 20_000
    similarity: float = 0.2
    depth: float = 0.02
    place_step: float = 1.6e-4
    scale_step: float = 3e-2
    rotation_step: float = 5e-3
    opacity_step: float = 5e-2
    colour_step: float = 5e-2
    seed: int = 0
    device: str = field(default_factory=default_device)

    def __post_init__(self) -> None:
        if min(self.steps, self.most) < 1:
            raise ValueError(f"{self.steps} steps of {self.most} Gaussians; there must be at least 1 of each")
        if not (0.0 <= self.similarity <= 1.0 and 0.0 <= self.depth <= 1.0):
            raise ValueError(
                f"weights must lie in [0, 1], got {self.similarity} of the SSIM and {self.depth} of the depth"
            )


@dataclass(frozen=True)
class FittedSplat:
    """What came out.

    Attributes:
        gaussians: the splat.
        losses: of every step, (steps,).
    """

    gaussians: Gaussians
    losses: Array


def fit_splat(
    views: list[SplatView],
    points: Array | None = None,
    config: SplatConfig | None = None,
    told: Told = lambda done, total, message: None,
) -> FittedSplat:
    """Fit a splat to pictures of one state.

    Args:
        views: calibrated cameras at the same moment, in one world.
        points: of the object's surface (P, 3) [m], where Gaussians begin; None: the views' depth says where.
        config: how.
        told: progress: steps done, steps, a message.

    Raises:
        SplatNotFitted: no view, nothing to begin with, or a fit that went to numbers that are not finite.
    """
    config = config or SplatConfig()
    if not views:
        raise SplatNotFitted("a splat is fitted to at least one picture, none was given")
    if points is None:
        start = start_from_depth(views, config.most)
    else:
        start = start_from_points(points, views, config.most)
    targets = [_target(view, start, config) for view in views]
    free = {name: tensor.requires_grad_() for name, tensor in _tensors(start).items()}
    extent = float(np.linalg.norm(np.ptp(start.means, axis=0)))
    rates = {
        "means": config.place_step * extent,
        "log_scales": config.scale_step,
        "rotations": config.rotation_step,
        "opacity_logits": config.opacity_step,
        "colours": config.colour_step,
    }
    adam = torch.optim.Adam([{"params": [free[n]], "lr": rate} for n, rate in rates.items()], eps=1e-15)
    rng = np.random.default_rng(config.seed)
    losses = np.zeros(config.steps)
    for step in range(config.steps):
        adam.param_groups[0]["lr"] = rates["means"] * 0.01 ** (step / config.steps)
        grey = float(rng.uniform())
        adam.zero_grad()
        loss = loss_of(free, targets[step % len(targets)], (grey, grey, grey), config)
        loss.backward()  # type: ignore[no-untyped-call]
        losses[step] = loss.item()
        if not np.isfinite(losses[step]):
            raise SplatNotFitted(f"the loss of step {step} of {config.steps} is {losses[step]}")
        adam.step()
        told(step + 1, config.steps, f"{len(start)} Gaussians, loss {losses[step]:.4f}")
    return FittedSplat(_gaussians({name: tensor.detach() for name, tensor in free.items()}), losses)


@dataclass(frozen=True)
class Target:
    """A view, cut to the box around its object.

    Attributes:
        view: the whole of it.
        left, top: of the box [px].
        picture: (h, w, 3) in [0, 1].
        inside: the object's pixels, (h, w) in {0, 1}.
        known: pixels that say something, (h, w) in {0, 1}.
        depth: (h, w) [m].
        measured: pixels whose depth counts, (h, w) in {0, 1}.
    """

    view: SplatView
    left: int
    top: int
    picture: Tensor
    inside: Tensor
    known: Tensor
    depth: Tensor
    measured: Tensor


def _target(view: SplatView, start: Gaussians, config: SplatConfig) -> Target:
    inside = view.inside
    height, width = inside.shape
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    top, bottom = max(rows[0] - MARGIN_PX, 0), min(rows[-1] + 1 + MARGIN_PX, height)
    left, right = max(columns[0] - MARGIN_PX, 0), min(columns[-1] + 1 + MARGIN_PX, width)
    box = (slice(top, bottom), slice(left, right))
    known, depth = np.ones_like(inside), np.zeros(inside.shape)
    if view.depth is not None:
        depth = view.depth
        own = Renderer(view.camera, device=config.device).render(start).depth
        known = inside | (depth <= 0) | (own <= 0) | (depth > own - IN_FRONT_M)

    def cut(values: Array) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values[box], dtype=np.float64))

    return Target(
        view, int(left), int(top), cut(view.picture / 255.0), cut(inside), cut(known), cut(depth),
        cut(inside & (depth > 0)),
    )  # fmt: skip


def loss_of(
    free: dict[str, Tensor], target: Target, background: tuple[float, float, float], config: SplatConfig
) -> Tensor:
    """The loss of one view.

    Args:
        free: ``means``, ``log_scales``, ``rotations`` (of any length but 0), ``opacity_logits`` and ``colours``
            (harmonics of degree 0).
        target: the view.
        background: behind the object, in [0, 1].
        config: weights.
    """
    height, width = target.inside.shape
    quaternions = free["rotations"] / free["rotations"].norm(dim=1, keepdim=True)
    seen = project(free["means"], free["log_scales"], quaternions, target.view.camera)
    centre = seen.centre - torch.tensor([target.left, target.top]).double()
    starts, order = tiles(
        centre.detach().numpy(), seen.reach, seen.depth.detach().numpy(), seen.good, width, height
    )
    canvas = Canvas(width, height, starts, order, background, config.device)
    rgb, alpha, far = Blend.apply(  # type: ignore[no-untyped-call]
        centre, seen.conic, torch.sigmoid(free["opacity_logits"]),
        (0.5 + SH_DC * free["colours"]).clamp(min=0.0), seen.depth, canvas,
    )  # fmt: skip
    inside, known = target.inside[..., None], target.known[..., None]
    wanted = target.picture * inside + torch.tensor(background).double() * (1.0 - inside)
    shown = rgb * known + wanted * (1.0 - known)
    counted = target.known.sum().clamp(min=1.0)
    loss: Tensor = (1.0 - config.similarity) * (shown - wanted).abs().sum() / (3.0 * counted)
    if config.similarity > 0:
        alike = structural_similarity_of(shown.float(), wanted.float()).double()
        loss = loss + config.similarity * (1.0 - alike)
    if config.depth > 0:
        # the mean depth, which no transparency makes fit; far off, at edges, it counts no more than 1 cm does
        covered = alpha.clamp(min=LEAST_COVERAGE)
        off = ((far / covered - target.depth) / DEPTH_SCALE_M).abs().clamp(max=1.0)
        weight = target.measured * alpha.detach()
        loss = loss + config.depth * (off * weight).sum() / target.measured.sum().clamp(min=1.0)
    return loss


def _tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    named: dict[str, Any] = {
        "means": gaussians.means,
        "log_scales": gaussians.log_scales,
        "rotations": gaussians.rotations,
        "opacity_logits": gaussians.opacity_logits,
        "colours": gaussians.harmonics[:, 0],
    }
    return {name: torch.from_numpy(np.array(values, dtype=np.float64)) for name, values in named.items()}


def _gaussians(free: dict[str, Tensor]) -> Gaussians:
    """The splat of these numbers, without what is as good as transparent."""
    kept = torch.sigmoid(free["opacity_logits"]) >= LEAST_OPACITY
    if not bool(kept.any()):
        raise SplatNotFitted(f"all {len(kept)} Gaussians have become transparent: is the mask the object's?")
    found = {name: values[kept].numpy() for name, values in free.items()}
    length = np.linalg.norm(found["rotations"], axis=1, keepdims=True)
    return Gaussians(
        found["means"], found["log_scales"], found["rotations"] / length, found["opacity_logits"],
        found["colours"][:, None],
    )  # fmt: skip
