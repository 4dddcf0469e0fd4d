"""``python -m physworld_workers.commands.splat SCENE --picture P --camera C --out splat.ply``: fit a splat to pictures.

SCENE says where the object's surface is: the cloud of its first frame, or its points. Pictures are of that frame;
``--picture``, ``--camera`` and ``--mask`` are given once a camera, in the same order. ``--camera`` is the JSON of
``physworld video``, ``--mask`` a PNG that is white on the object. The splat is what ``physworld video --gaussians`` and
``physworld scenes picture`` take.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.devices import default_device

if TYPE_CHECKING:
    from physworld.video import FittedSplat, SplatConfig, SplatView


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, fit, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _splat(given))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="physworld splat", description="Fit a splat to pictures.")
    parser.add_argument("scene", type=Path, help="scene whose first frame the pictures show")
    parser.add_argument("--picture", type=Path, action="append", required=True, help="PNG or JPEG")
    parser.add_argument("--camera", type=Path, action="append", required=True, help="its camera, JSON")
    parser.add_argument("--mask", type=Path, action="append", default=[], help="PNG, white on the object")
    parser.add_argument("--out", type=Path, required=True, help="the splat, PLY")
    parser.add_argument("--steps", type=int, default=None, help="of the fit")
    parser.add_argument("--most", type=int, default=None, help="Gaussians at most")
    parser.add_argument("--json", type=Path, default=None, help="write the losses to this file")
    parser.add_argument("--device", default=default_device(), help="cpu or cuda:0")
    return parser


def _splat(given: argparse.Namespace) -> None:
    from physworld.video import SplatConfig, SplatView, surface_of
    from physworld_workers.commands.terminal import read_scene
    from physworld_workers.commands.video import camera_in

    if len(given.camera) != len(given.picture) or len(given.mask) not in (0, len(given.picture)):
        raise ValueError(
            f"{len(given.picture)} pictures need as many cameras, and masks or none; got {len(given.camera)} cameras "
            f"and {len(given.mask)} masks"
        )
    scene = read_scene(given.scene)
    masks = given.mask or [None] * len(given.picture)
    views = [
        SplatView(
            camera_in(camera), _pixels(picture, "RGB"), None if mask is None else _pixels(mask, "L") > 127
        )
        for picture, camera, mask in zip(given.picture, given.camera, masks, strict=True)
    ]
    told = {"steps": given.steps, "most": given.most, "device": given.device}
    config = SplatConfig(**{name: value for name, value in told.items() if value is not None})
    fitted = fitted_splat(views, surface_of(scene), config, given.out)
    if given.json is not None:
        facts = {"gaussians": len(fitted.gaussians), "losses": fitted.losses.tolist()}
        given.json.write_text(json.dumps(facts, indent=2) + "\n")


def fitted_splat(views: list[SplatView], points: Array | None, config: SplatConfig, out: Path) -> FittedSplat:
    """Fit with a progress bar, write the PLY and say what came out.

    Args:
        views: pictures of one state.
        points: of the surface (P, 3) [m]; None: the views have depth.
        config: of the fit.
        out: the file.

    Raises:
        SplatNotFitted: see ``physworld.video.fit_splat``.
    """
    import warp as wp

    wp.config.quiet = True
    from physworld.video import fit_splat, to_ply
    from physworld_workers.commands.terminal import progress_bar

    with progress_bar(f"splat {out.name}") as shown:
        fitted = fit_splat(views, points, config, shown)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(to_ply(fitted.gaussians))
    tenth = max(config.steps // 10, 1)  # single losses depend on the step's background
    first, last = fitted.losses[:tenth].mean(), fitted.losses[-tenth:].mean()
    print(f"{out}: {len(fitted.gaussians)} Gaussians, loss {first:.4f} to {last:.4f} in {config.steps} steps")
    return fitted


def _pixels(path: Path, mode: str) -> Array:
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG", "JPEG")) as picture:
            return np.asarray(picture.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path} is no picture: {str(error)[:160]}") from error


if __name__ == "__main__":
    sys.exit(main())
