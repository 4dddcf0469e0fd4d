"""``python -m benchmarks.tracking render NAME FOLDER [--cameras N]`` and ``... measure FOLDER... [--json FILE]``,
``... whole FOLDER... [--trace]``, ``... splat FOLDER...`` and ``... tail [--picture PNG] [--over PNG]``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from benchmarks.tracking.plays import FRAMES, PLAYS


def main() -> None:
    """Render a recording, or follow and score recordings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tracking", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    render = commands.add_parser("render", help="write a recording of known truth")
    render.add_argument("name", choices=sorted(PLAYS))
    render.add_argument("folder", type=Path)
    render.add_argument("--cameras", type=int, default=1, choices=(1, 2, 3))
    render.add_argument("--frames", type=int, default=FRAMES)
    render.add_argument("--seed", type=int, default=0)
    measure = commands.add_parser("measure", help="follow and score recordings")
    measure.add_argument("folders", type=Path, nargs="+")
    measure.add_argument("--json", type=Path, default=None, help="write the figures to this file")
    measure.add_argument("--scenes", type=Path, default=None, help="keep the scenes in this folder")
    splat = commands.add_parser("splat", help="fit a splat to the first frame and compare all frames")
    splat.add_argument("folders", type=Path, nargs="+")
    splat.add_argument("--steps", type=int, default=None)
    splat.add_argument("--most", type=int, default=None, help="Gaussians")
    splat.add_argument("--whole", action="store_true", help="the whole picture instead of the object")
    splat.add_argument("--json", type=Path, default=None, help="write the figures to this file")
    whole = commands.add_parser("whole", help="import, fit and compare with a fit of exact tracks")
    whole.add_argument("folders", type=Path, nargs="+")
    whole.add_argument("--particles", type=int, default=1000)
    whole.add_argument(
        "--trace", action="store_true", help="trace the imported scenes instead of fitting them"
    )
    whole.add_argument("--json", type=Path, default=None, help="write the figures to this file")
    tail = commands.add_parser("tail", help="follow a real film, fetched as part of a package")
    tail.add_argument("--points", type=int, default=80)
    tail.add_argument("--picture", type=Path, default=None, help="PNG of what was followed")
    tail.add_argument("--over", type=Path, default=None, help="the same over the film's frames")
    tail.add_argument("--json", type=Path, default=None, help="write the figures to this file")
    given = parser.parse_args()
    if given.command == "tail":
        _tail(given)
        return
    if given.command == "render":
        from benchmarks.tracking.render import write

        write(given.name, given.folder, given.cameras, given.frames, given.seed)
        return
    if given.command == "splat":
        _splat(given)
        return
    if given.command == "whole":
        _whole(given)
        return
    from benchmarks.tracking.measure import scene_of, score, table
    from physworld_scenes.bundle import write_bundle

    figures = []
    for folder in given.folders:
        scene, seconds = scene_of(folder)
        figures.append(score(folder, scene, seconds).figures)
        print(json.dumps(figures[-1]), flush=True)
        if given.scenes is not None:
            write_bundle(scene, given.scenes / folder.name)
    print(table(figures))
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1) + "\n")


def _tail(given: argparse.Namespace) -> None:
    import time

    from benchmarks.tracking import tail

    frames, rate = tail.film()
    began = time.perf_counter()
    scene, warnings, followed = tail.scene_of(frames, rate, given.points)
    seconds = time.perf_counter() - began
    figures = {**tail.score(frames, scene, followed), "frames": len(frames), "seconds": round(seconds, 1)}
    print(json.dumps(figures, indent=1))
    for warning in warnings:
        print(f"warning: {warning}")
    for path, over in ((given.picture, False), (given.over, True)):
        if path is not None:
            tail.draw(frames, scene, followed, path, over)
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1) + "\n")


def _whole(given: argparse.Namespace) -> None:
    from benchmarks.tracking.whole import named, table, whole_way

    figures = []
    for folder in given.folders:
        figures.append((named if given.trace else whole_way)(folder, given.particles))
        print(json.dumps(figures[-1]), flush=True)
        if given.json is not None:
            given.json.write_text(json.dumps(figures, indent=1) + "\n")
    if not given.trace:
        print(table(figures))


def _splat(given: argparse.Namespace) -> None:
    from benchmarks.tracking.splat import score_splat, table
    from physworld.video import SplatConfig

    told = {"steps": given.steps, "most": given.most}
    config = SplatConfig(**{name: value for name, value in told.items() if value is not None})
    figures = []
    for folder in given.folders:
        figures.append(score_splat(folder, config, given.whole))
        print(json.dumps(figures[-1]), flush=True)
    print(table(figures))
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
