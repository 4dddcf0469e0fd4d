"""How well a splat that was fitted to the first frame shows that frame, and the later ones when the true motion
carries it.

The object's pixels are those where the recording's depth is that of the true surface, so that grippers and sticks do
not count. PSNR is over these pixels alone, and over the box around them with everything else white.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracking.plays import marker_picture
from benchmarks.tracking.raycast import Stage, Surface
from physworld.arrays import Array
from physworld.tracking.recording import masks_of
from physworld.tracking.view import Box, View
from physworld.video import GaussianCarrier, Renderer, SplatConfig, SplatView, compare_frames, fit_splat
from physworld_scenes.importers.pictures import read_pictures

SAME_SURFACE_M = 0.01
FAR_BELOW_M = -1e3
MARGIN_PX = 6
"""Around the object, so that a rope is wider than the window of SSIM."""


def score_splat(folder: Path, config: SplatConfig | None = None, whole: bool = False) -> dict[str, Any]:
    """Fit to the first frame of a rendered recording and compare all frames; the figures.

    Args:
        folder: written by ``render``.
        config: of the fit.
        whole: fit the whole picture of the first frame instead of the object, and compare that.
    """
    facts, truth = json.loads((folder / "truth.json").read_text()), np.load(folder / "truth.npz")
    vertices = truth["vertices"].astype(np.float64)
    views = read_pictures(folder, None, slice(0, None)).views
    masks: list[Any] = [None] * len(views)
    if not whole:
        boxes = [Box(*facts["box_px"]) if number == 0 else None for number in range(len(views))]
        masks = masks_of(views, boxes, [None] * len(views), None).each
    shown = [
        SplatView(view.camera, view.colour(0), mask, view.depth(0))
        for view, mask in zip(views, masks, strict=True)
        if whole or mask is not None
    ]
    began = time.process_time()
    fitted = fit_splat(shown, config=config)
    seconds = time.process_time() - began
    found: dict[str, Any] = {
        "recording": folder.name,
        "views": len(shown),
        "what": "whole picture" if whole else "object",
        "pixels": int(sum(view.inside.sum() for view in shown)),
        "gaussians": len(fitted.gaussians),
        "processor_seconds": round(seconds, 1),
        "first_loss": round(float(fitted.losses[: len(shown)].mean()), 4),
        "last_loss": round(float(fitted.losses[-len(shown) :].mean()), 4),
    }
    if whole:
        picture = Renderer(views[0].camera).render(fitted.gaussians)
        return found | {"psnr_db": round(_psnr(picture.rgb, views[0].colour(0) / 255.0), 2)}
    stage = Stage([Surface(truth["triangles"], vertices[0])], FAR_BELOW_M, marker_picture())
    carrier = GaussianCarrier(fitted.gaussians, vertices[0])
    renderer = Renderer(views[0].camera)
    asked = sorted({0, 10, 30, 60, len(vertices) - 1} & set(range(len(vertices))))
    rows = {
        frame: _compare(
            stage, views[0], renderer.render(*carrier.at(vertices[frame])), vertices[frame], frame
        )
        for frame in asked
    }
    return found | {"frames": {str(frame): row for frame, row in rows.items()}}


def table(figures: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| recording | views | pixels | Gaussians | PSNR of frames [dB] | IoU | processor [s] |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in figures:
        frames = row.get("frames", {"0": {"psnr_where_both_db": row.get("psnr_db"), "iou": 1.0}})
        names = ", ".join(frames)
        ratios = ", ".join(f"{each['psnr_where_both_db']:.1f}" for each in frames.values())
        overlaps = ", ".join(f"{each['iou']:.2f}" for each in frames.values())
        lines.append(
            f"| {row['recording']}, {row['what']} | {row['views']} | {row['pixels']} | {row['gaussians']} | "
            f"{names}: {ratios} | {overlaps} | {row['processor_seconds']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def _compare(stage: Stage, view: View, picture: Any, vertices: Array, frame: int) -> dict[str, float]:
    _, depth, seen = stage.show(vertices, view.camera)
    object_here = seen == 0
    measured = view.depth(frame)
    covered = (measured > 0) & (measured < depth - SAME_SURFACE_M) & object_here
    visible = object_here & (np.abs(measured - depth) < SAME_SURFACE_M)
    given = view.colour(frame) / 255.0
    wanted = np.where(visible[..., None], given, 1.0)
    rendered = np.where(covered[..., None] | (object_here & ~visible)[..., None], 1.0, picture.rgb)
    rows, columns = np.nonzero(object_here)
    box = tuple(slice(max(at.min() - MARGIN_PX, 0), at.max() + 1 + MARGIN_PX) for at in (rows, columns))
    scores = compare_frames(rendered[box][None], wanted[box][None])
    alpha = np.where(object_here & ~visible, False, picture.alpha >= 0.5)
    both = visible & (picture.alpha >= 0.5)
    return {
        "psnr_where_both_db": round(_psnr(picture.rgb[both], given[both]), 2),
        "psnr_on_object_db": round(_psnr(picture.rgb[visible], given[visible]), 2),
        "psnr_box_db": round(scores.psnr_db, 2),
        "ssim_box": round(scores.ssim, 3),
        "iou": round(float((alpha & visible).sum() / (alpha | visible).sum()), 3),
    }


def _psnr(one: Array, other: Array) -> float:
    return float(-10.0 * np.log10(np.mean((one - other) ** 2)))
