"""Draws a film: the motion of a recording, a twin, a model's prediction or a rollout, as the command line does.

A scene may have pictures beside its archive (``physworld_storage.videos.put_picture``): ``splat.ply`` is its object in
the first frame, ``camera.json`` where its pictures were taken from, ``frames.npz`` these pictures, ``frames``
(T, H, W, 3) uint8 and, where the object's pixels are known, ``masks`` (T, H, W). They come from strangers and are read
here, within the limits of archives.

The file is ``film.mp4`` (H.264). A film of the recording's own motion, seen from the pictures' camera, is scored
against them frame by frame, and ``recording.mp4`` shows them at the same times; otherwise the report says why not.
LPIPS is among the scores where its weights are installed beside the worker (``physworld_workers.lpips_weights``).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.devices import torch_device
from physworld.video import (
    Drawing,
    SplatConfig,
    SplatView,
    checked_motion,
    compare_frames,
    eight_bit,
    encode_mp4,
    fit_splat,
    frames_per_second,
    from_ply,
    surface_of,
    to_ply,
    whole_motion_view,
)
from physworld.video.gaussians import Gaussians
from physworld.video.hidden import followed
from physworld.video.lpips import LEAST_SIDE_PX, Lpips
from physworld_scenes.archives import ArchiveLimits, read_arrays
from physworld_schemas.base import Reference
from physworld_schemas.video import (
    FILM,
    MOST_FRAMES,
    RECORDING,
    CameraView,
    VideoConfig,
    VideoReport,
    VideoScores,
)
from physworld_storage import resources
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.lpips_weights import are_installed, installed_weights
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import npz_arrays, scene_of, scene_reference

SPLAT, CAMERA, FRAMES = "splat.ply", "camera.json", "frames.npz"
PICTURE_LIMITS = ArchiveLimits(total_bytes=2 << 30, members=8, ratio=2000.0)
MOVING = {"fit": ("particles", "tracks"), "model": ("tracks",), "rollout": ("vertices", "points")}
"""What is drawn of the arrays of each kind: the first of these names that they hold."""

SeenFrom = Literal["given", "scene", "whole"]


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Read, draw, compare, store."""
    started = time.perf_counter()
    payload = context.lease.payload
    config = VideoConfig.model_validate(payload["config"])
    moved, times = motion_of(stores, payload, config.candidate)
    pictures = _pictures_of(stores, payload["scene_id"])
    camera, seen_from = _camera(config, moved, stores, pictures)
    fitted = None
    if config.look == "fitted":
        fitted = _fitted(context, stores, pictures, payload["scene_id"])
    splat = _splat(stores, pictures) if config.look == "auto" else fitted
    drawing = Drawing(moved, moved[0], camera, splat, stores.settings.device)
    frames, not_scored = _frames_to_match(stores, pictures, payload["of"], seen_from, camera, len(moved))
    lpips = None if frames is None else _lpips(frames["frames"], stores.settings.device)
    scoring = Scoring(frames, lpips)

    def drawn() -> Iterator[Array]:
        context.progress(0, len(moved), "frames", "drawing")
        for number, picture in enumerate(drawing.frames()):
            context.check()
            colours = eight_bit(picture)
            scoring.add(number, colours, picture.alpha)
            yield colours
            context.progress(number + 1, len(moved), "frames", "drawing")

    fps = frames_per_second(times)
    made = [stores.artifacts.put_bytes(encode_mp4(drawn(), fps), FILM, "video/mp4")]
    if frames is not None:
        recorded = encode_mp4(_while_wanted(context, frames["frames"]), fps)
        made.append(stores.artifacts.put_bytes(recorded, RECORDING, "video/mp4"))
    context.check()
    report = VideoReport(
        frames=len(moved),
        fps=fps,
        drawn="points" if splat is None else "splat" if fitted is None else "fitted",
        gaussians=drawing.gaussians,
        seen_from=seen_from,
        camera=_view_of(camera),
        scores=scoring.result(),
        not_scored=not_scored,
        seconds=time.perf_counter() - started,
    )
    inputs = [Reference.model_validate(payload["source"])]
    if payload["of"] != "scene":
        inputs.append(scene_reference(stores, payload["scene_id"]))
    inputs += [Reference(kind="artifact", id=name, digest=digest) for name, digest in pictures.items()]
    made_by = lineage_of(inputs, {"video": payload["config"]}, {}, stores.settings.device)
    if fitted is not None:
        made.append(stores.artifacts.put_bytes(to_ply(fitted), SPLAT, "application/x-ply"))
    result = {
        "report": report.model_dump(mode="json"),
        "artifacts": [item.model_dump(mode="json") for item in made],
    }
    return HandlerResult({**result, "lineage": made_by}, made[0].sha256)


def _while_wanted(context: TaskContext, frames: Array) -> Iterator[Array]:
    """The frames (T, H, W, 3) one by one. Raises when the job is called off."""
    for frame in frames:
        context.check()
        yield frame


def motion_of(stores: Stores, payload: dict[str, Any], candidate: int) -> tuple[Array, Array]:
    """Points (T, n, 3) [m] that move, and the frames' times (T,) [s]. Raises ValueError with the numbers."""
    of, source = payload["of"], payload["source"]["id"]
    if of == "scene":
        scene = scene_of(stores, payload["scene_id"])
        seen = scene.visible.any(axis=0)
        if np.count_nonzero(seen) < 2:
            raise ValueError(
                f"{np.count_nonzero(seen)} points of scene {source} are ever seen; a film needs 2"
            )
        moved = followed(scene.points[:, seen], scene.visible[:, seen])
        times = scene.times
    else:
        arrays = npz_arrays(stores.artifacts.read_bytes(payload["motion"]))
        name = next((key for key in MOVING[of] if key in arrays), None)
        if name is None:
            raise ValueError(
                f"the arrays of {of} {source} are {sorted(arrays)}, none of {', '.join(MOVING[of])}"
            )
        moved, times = arrays[name], arrays["times"]
        if moved.ndim == 4:
            if candidate >= len(moved):
                raise ValueError(
                    f"{of} {source} has {len(moved)} candidates; there is no candidate {candidate}"
                )
            moved = moved[candidate]
    moved = checked_motion(moved, f"the motion of {of} {source}")
    if len(times) != len(moved):
        raise ValueError(f"{of} {source} has {len(times)} times for {len(moved)} frames")
    if len(moved) > MOST_FRAMES:
        raise ValueError(f"{of} {source} has {len(moved)} frames; a film has at most {MOST_FRAMES}")
    return moved, np.asarray(times, dtype=np.float64)


@dataclass
class Scoring:
    """Scores of a film, frame by frame as it is drawn.

    Attributes:
        given: ``frames`` (T, H, W, 3) and, if there are some, ``masks`` (T, H, W); None scores nothing.
        lpips: distance of two pictures (H, W, 3) in [0, 1]; None: not measured.
        found: by name, one number a frame.
    """

    given: dict[str, Array] | None
    lpips: Callable[[Array, Array], float] | None = None
    found: dict[str, list[float]] = field(default_factory=dict)

    def add(self, number: int, colours: Array, coverage: Array) -> None:
        """Compare one frame: colours (H, W, 3) uint8, coverage (H, W) in [0, 1]."""
        if self.given is None:
            return
        masks = self.given.get("masks")
        scores = compare_frames(
            colours[None],
            self.given["frames"][number : number + 1],
            None if masks is None else coverage[None],
            None if masks is None else masks[number : number + 1],
            self.lpips,
        )
        for name, values in scores.per_frame.items():
            self.found.setdefault(name, []).append(float(values[0]))

    def result(self) -> VideoScores | None:
        """Means and frames; equal frames have no finite PSNR and stay out of its mean."""
        if self.given is None:
            return None
        ratios = [value if np.isfinite(value) else None for value in self.found["psnr_db"]]
        finite = [value for value in ratios if value is not None]
        overlaps, distances = self.found.get("iou"), self.found.get("lpips")
        return VideoScores(
            psnr_db=float(np.mean(finite)) if finite else None,
            ssim=float(np.mean(self.found["ssim"])),
            iou=None if overlaps is None else float(np.mean(overlaps)),
            psnr_db_per_frame=ratios,
            ssim_per_frame=self.found["ssim"],
            iou_per_frame=overlaps,
            lpips=None if distances is None else float(np.mean(distances)),
            lpips_per_frame=distances,
        )


def _lpips(frames: Array, device: str) -> Lpips | None:
    """By AlexNet, where its weights are installed and the frames (T, H, W, 3) are large enough for it."""
    if min(frames.shape[1:3]) < LEAST_SIDE_PX["alexnet"] or not are_installed("alexnet"):
        return None
    return Lpips(installed_weights("alexnet"), torch_device(device))


def _pictures_of(stores: Stores, scene_id: str) -> dict[str, str]:
    """Digests of the pictures beside the scene, by name."""
    with stores.database.reading() as session:
        artifacts = resources.get_scene(session, scene_id).artifacts
    return {item.name: item.sha256 for item in artifacts if item.name in (SPLAT, CAMERA, FRAMES)}


def _camera(
    config: VideoConfig, moved: Array, stores: Stores, pictures: dict[str, str]
) -> tuple[Camera, SeenFrom]:
    if config.camera is not None:
        return camera_of(config.camera), "given"
    if config.view == "auto" and CAMERA in pictures:
        return _scene_camera(stores, pictures), "scene"
    angles = (config.azimuth_deg, config.elevation_deg)
    return whole_motion_view(moved, *angles, config.width, config.height), "whole"


def _scene_camera(stores: Stores, pictures: dict[str, str]) -> Camera:
    try:
        view = CameraView.model_validate(json.loads(stores.artifacts.read_bytes(pictures[CAMERA])))
    except (ValidationError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{CAMERA} of the scene is no camera: {error}") from error
    return camera_of(view)


def camera_of(view: CameraView) -> Camera:
    """The library's camera. Raises ValueError for a transform that is not rigid."""
    given = view.model_dump(exclude={"world_to_camera"})
    return Camera(**given, world_to_camera=np.asarray(view.world_to_camera, dtype=np.float64))


def _view_of(camera: Camera) -> CameraView:
    numbers = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    sizes = {"width": camera.width, "height": camera.height}
    return CameraView(**sizes, **numbers, world_to_camera=camera.world_to_camera.tolist())


def _splat(stores: Stores, pictures: dict[str, str]) -> Gaussians | None:
    if SPLAT not in pictures:
        return None
    return from_ply(stores.artifacts.read_bytes(pictures[SPLAT]))


def _fitted(context: TaskContext, stores: Stores, pictures: dict[str, str], scene_id: str) -> Gaussians:
    """A splat of the scene's first picture."""
    missing = [name for name in (CAMERA, FRAMES) if name not in pictures]
    if missing:
        raise ValueError(f"a splat is fitted to the scene's pictures; it has no {' and no '.join(missing)}")
    given = _frames_of(stores, pictures)
    mask = given["masks"][0] if "masks" in given else None
    view = SplatView(_scene_camera(stores, pictures), given["frames"][0], mask)

    def told(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, "steps", f"fitting {message}")

    config = SplatConfig(device=stores.settings.device)
    return fit_splat([view], surface_of(scene_of(stores, scene_id)), config, told).gaussians


def _frames_of(stores: Stores, pictures: dict[str, str]) -> dict[str, Array]:
    """``frames`` (T, H, W, 3) uint8 and, if there are some, ``masks`` (T, H, W), of the scene's pictures."""
    found = read_arrays(stores.artifacts.read_bytes(pictures[FRAMES]), PICTURE_LIMITS)
    frames, masks = found.get("frames"), found.get("masks")
    if (
        frames is None
        or frames.ndim != 4
        or frames.shape[-1] != 3
        or frames.dtype != np.uint8
        or not frames.size
    ):
        shown = {name: f"{array.dtype} {array.shape}" for name, array in found.items()}
        raise ValueError(f"{FRAMES} of the scene must hold frames (T, H, W, 3) uint8, it holds {shown}")
    if masks is None:
        return {"frames": frames}
    if masks.shape != frames.shape[:3]:
        raise ValueError(
            f"masks in {FRAMES} of the scene have shape {masks.shape}, its frames {frames.shape[:3]}"
        )
    return {"frames": frames, "masks": masks}


def _frames_to_match(
    stores: Stores, pictures: dict[str, str], of: str, seen_from: SeenFrom, camera: Camera, count: int
) -> tuple[dict[str, Array] | None, str]:
    """The pictures that the film is scored against, or None and why there are none."""
    if FRAMES not in pictures:
        return None, "the scene has no pictures"
    if of == "rollout":
        return None, "a rollout has a motion of its own, which the scene's pictures do not show"
    if seen_from == "whole":
        return None, "the film is not seen from the camera of the scene's pictures"
    given = _frames_of(stores, pictures)
    frames = given["frames"]
    wanted = (count, camera.height, camera.width)
    if frames.shape[:3] != wanted:
        return None, (
            f"the scene's pictures are {frames.shape[0]} of {frames.shape[2]} x {frames.shape[1]} px, the film has "
            f"{count} of {camera.width} x {camera.height} px"
        )
    return given, ""
