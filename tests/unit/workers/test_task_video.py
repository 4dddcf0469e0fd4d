"""A film in its real handler: what it draws, from where, how it is scored, how it is refused and called off."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import av
import numpy as np
import pytest
from tiny_scene import tiny_scene

from physworld.arrays import Array
from physworld.video import Drawing, from_ply, gaussians_at_points, orbit_view, to_ply
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.video import FILM, RECORDING, CameraView, Video, VideoConfig, VideoCreate
from physworld_storage import removal, videos
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs import jobs, leases
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.stores import Stores
from physworld_workers.tasks import video as task

pytestmark = pytest.mark.slow

SMALL = VideoConfig(width=64, height=48)
RuntimeOf = Callable[..., Runtime]


def asked(stores: Stores, scene_id: str, config: VideoConfig = SMALL) -> Job:
    with stores.database.session() as session:
        return jobs.create_video(session, VideoCreate(of="scene", id=scene_id, config=config))


def drawn(stores: Stores, runtime: Runtime, job: Job) -> tuple[str, Job, Video]:
    with stores.database.reading() as session:
        (waiting,) = leases.publishable(session)
    outcome = run_shard(runtime, waiting.shard_id)
    with stores.database.reading() as session:
        return outcome, jobs.get_job(session, job.id), videos.get_video(session, job.outputs[0].id)


def keep(stores: Stores, scene_id: str, name: str, content: bytes) -> None:
    with stores.database.session() as session:
        videos.put_picture(session, scene_id, stores.artifacts.put_bytes(content, name))


def frames_of(stores: Stores, video: Video, name: str = FILM) -> Array:
    film = next(item for item in video.artifacts if item.name == name)
    assert film.media_type == "video/mp4"
    with av.open(io.BytesIO(stores.artifacts.read_bytes(film.sha256))) as opened:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)])


def npz(**arrays: Array) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def view() -> CameraView:
    scene = tiny_scene()
    camera = orbit_view(scene.points.reshape(-1, 3), 30.0, 10.0, 64, 48)
    return CameraView(
        width=64, height=48, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
        world_to_camera=camera.world_to_camera.tolist(),
    )  # fmt: skip


def test_a_recording_is_drawn_as_points_with_the_whole_motion_in_view(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    outcome, job, video = drawn(stores, runtime_with(), asked(stores, scene_id))
    scene = tiny_scene()
    assert outcome == "done" and job.state == "succeeded" and video.report is not None
    assert job.progress.total == len(scene.times) and job.progress.fraction == 1.0
    assert job.outputs[0].digest == video.artifacts[0].sha256
    report = video.report
    assert (report.frames, report.drawn, report.seen_from) == (len(scene.times), "points", "whole")
    assert report.fps == pytest.approx(1.0 / np.median(np.diff(scene.times)))
    assert report.scores is None and report.not_scored == "the scene has no pictures"
    assert [item.name for item in video.artifacts] == [FILM]
    pictures = frames_of(stores, video)
    assert pictures.shape == (len(scene.times), 48, 64, 3)
    assert all((picture < 128).any() for picture in pictures)  # something dark on white in every frame
    camera = task.camera_of(report.camera)
    pixels, depths = camera.project(scene.points.reshape(-1, 3))
    assert (depths > 0).all() and (pixels > 0).all() and (pixels < (64, 48)).all()


def test_what_is_hidden_moves_on_and_what_is_never_seen_is_left_out(
    stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny_scene()
    visible = scene.visible.copy()
    visible[:, 0] = False
    visible[3:, 1] = False
    points = scene.points.copy()
    points[:, 0] = points[3:, 1] = 1e6
    stores.cached(("scene", scene_id), lambda: replace(scene, visible=visible, points=points))
    payload = {"of": "scene", "scene_id": scene_id, "source": {"kind": "scene", "id": scene_id}}
    moved, _ = task.motion_of(stores, payload, 0)
    assert moved.shape[1] == scene.points.shape[1] - 1
    np.testing.assert_allclose(moved[:, 0], scene.points[:, 1], atol=1e-9)


def test_the_splat_and_the_camera_of_the_scene_are_taken_and_its_pictures_compared(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    scene = tiny_scene()
    keep(stores, scene_id, "splat.ply", to_ply(gaussians_at_points(scene.points[0])))
    keep(stores, scene_id, "camera.json", view().model_dump_json().encode())
    _, _, first = drawn(stores, runtime_with(), asked(stores, scene_id))
    assert first.report is not None and (first.report.drawn, first.report.seen_from) == ("splat", "scene")
    assert first.report.gaussians == scene.points.shape[1]
    pictures = frames_of(stores, first)
    masks = (pictures < 200).any(axis=3)
    keep(stores, scene_id, "frames.npz", npz(frames=pictures, masks=masks))
    _, _, second = drawn(stores, runtime_with(), asked(stores, scene_id))
    scores = second.report.scores if second.report else None
    assert scores is not None and second.report is not None and second.report.not_scored == ""
    assert scores.psnr_db is not None and scores.psnr_db > 25 and scores.ssim > 0.9 and scores.iou is not None
    assert min(value or 0.0 for value in scores.psnr_db_per_frame) > 25  # each frame against its own picture
    assert scores.iou > 0.5 and len(scores.psnr_db_per_frame) == len(scores.ssim_per_frame) == len(pictures)
    assert [item.name for item in second.artifacts] == [FILM, RECORDING]
    recorded = frames_of(stores, second, RECORDING)
    assert recorded.shape == pictures.shape and abs(recorded.astype(float) - pictures).mean() < 4
    keep(stores, scene_id, "frames.npz", npz(frames=255 - pictures))
    _, _, third = drawn(stores, runtime_with(), asked(stores, scene_id))
    assert third.report is not None and third.report.scores is not None
    assert third.report.scores.psnr_db is not None and third.report.scores.psnr_db < 8
    names = {reference.id for reference in third.lineage.inputs if reference.kind == "artifact"}
    assert names == {"splat.ply", "camera.json", "frames.npz"}
    plain = VideoConfig(width=64, height=48, look="points", view="whole")
    _, _, fourth = drawn(stores, runtime_with(), asked(stores, scene_id, plain))
    assert fourth.report is not None and (fourth.report.drawn, fourth.report.seen_from) == ("points", "whole")
    assert "not seen from the camera" in fourth.report.not_scored


def test_pictures_of_another_size_or_count_are_named_with_their_numbers(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    count = len(tiny_scene().times)
    keep(stores, scene_id, "frames.npz", npz(frames=np.zeros((count, 24, 32, 3), np.uint8)))
    config = VideoConfig(camera=view())
    _, _, video = drawn(stores, runtime_with(), asked(stores, scene_id, config))
    assert video.report is not None and video.report.seen_from == "given"
    assert f"are {count} of 32 x 24 px, the film has {count} of 64 x 48 px" in video.report.not_scored


def test_lpips_is_a_score_where_its_weights_are_installed(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = len(tiny_scene().times)
    keep(stores, scene_id, "frames.npz", npz(frames=np.zeros((count, 48, 64, 3), np.uint8)))
    asked_for = VideoConfig(camera=view())
    found = {}
    for net in ("absent", "there"):
        monkeypatch.setattr(task, "are_installed", lambda _, net=net: net == "there")
        monkeypatch.setattr(task, "installed_weights", lambda name: name)
        monkeypatch.setattr(task, "Lpips", lambda *_: lambda one, other: float(np.abs(one - other).mean()))
        _, _, video = drawn(stores, runtime_with(), asked(stores, scene_id, asked_for))
        assert video.report is not None and video.report.scores is not None
        found[net] = video.report.scores
    assert found["absent"].lpips is None and found["absent"].lpips_per_frame is None
    distances = found["there"].lpips_per_frame
    assert distances is not None and len(distances) == count and min(distances) > 0.5
    assert found["there"].lpips == pytest.approx(np.mean(distances))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("splat.ply", b"ply\nnonsense", "PLY"),
        ("frames.npz", b"PK\x03\x04nonsense", "damaged"),
        ("frames.npz", npz(frames=np.zeros((3, 4), np.uint8)), "must hold frames (T, H, W, 3) uint8"),
        ("camera.json", json.dumps({"width": 1}).encode(), "camera.json of the scene is no camera"),
    ],
)
def test_pictures_that_cannot_be_read_fail_the_job_by_name(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str, name: str, content: bytes, said: str
) -> None:
    keep(stores, scene_id, name, content)
    config = SMALL if name == "camera.json" else VideoConfig(camera=view())
    outcome, job, video = drawn(stores, runtime_with(), asked(stores, scene_id, config))
    assert outcome == "failed" and (job.state, video.state) == ("failed", "failed")
    assert job.error is not None and said in job.error.detail, job.error


def test_a_camera_that_is_not_rigid_is_refused_with_its_shape(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    bent = view().model_copy(update={"world_to_camera": (2.0 * np.eye(4)).tolist()})
    outcome, job, _ = drawn(stores, runtime_with(), asked(stores, scene_id, VideoConfig(camera=bent)))
    assert outcome == "failed" and job.error is not None and "rigid transform" in job.error.detail


def test_a_film_that_is_called_off_stops_and_leaves_nothing(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = asked(stores, scene_id)
    made = Drawing.frames
    shown: list[int] = []

    def slow(drawing: Drawing) -> object:
        for number, picture in enumerate(made(drawing)):
            if number == 1:
                with stores.database.session() as session:
                    jobs.cancel_job(session, job.id)
            if number >= 1:
                time.sleep(0.3)
            shown.append(number)
            yield picture

    monkeypatch.setattr(Drawing, "frames", slow)
    outcome, ended, video = drawn(stores, runtime_with(), job)
    assert outcome == "cancelled" and ended.state == "cancelled" and video.state == "cancelled"
    assert len(shown) < len(tiny_scene().times) and video.artifacts == []


def test_only_what_is_there_and_ready_is_drawn(stores: Stores, scene_id: str) -> None:
    with stores.database.session() as session:
        pending = jobs.create_fit(session, scene_id, FitConfig()).outputs[0].id
    for of, id_ in (("scene", "scn_none"), ("fit", "fit_none"), ("model", "none"), ("rollout", "rol_none")):
        with stores.database.session() as session, pytest.raises(NotFound):
            jobs.create_video(session, VideoCreate(of=of, id=id_))  # type: ignore[arg-type]
    with (
        stores.database.session() as session,
        pytest.raises(Conflict, match="is pending; a film shows what is"),
    ):
        jobs.create_video(session, VideoCreate(of="fit", id=pending))


def test_a_twin_is_drawn_from_its_prediction_and_stays_while_its_film_does(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    scene = tiny_scene()
    prediction = npz(times=scene.times, tracks=scene.points, particles=np.repeat(scene.points, 3, axis=1))
    with stores.database.session() as session:
        fit_id = jobs.create_fit(session, scene_id, FitConfig()).outputs[0].id
        (waiting,) = leases.publishable(session)
        lease = leases.claim(session, waiting.shard_id, "test", 60.0)
        files = [stores.artifacts.put_bytes(prediction, "prediction.npz").model_dump()]
        assert lease is not None
        assert leases.complete(session, lease, {"parameters": {}, "metrics": {}, "artifacts": files})
    with stores.database.session() as session:
        job = jobs.create_video(session, VideoCreate(of="fit", id=fit_id, config=SMALL))
    outcome, _, video = drawn(stores, runtime_with(), job)
    assert outcome == "done" and video.report is not None
    assert (video.of, video.source_id, video.scene_id) == ("fit", fit_id, scene_id)
    assert video.report.gaussians == 12 and video.report.frames == len(scene.times)
    assert [reference.kind for reference in video.lineage.inputs] == ["fit", "scene"]
    with stores.database.session() as session, pytest.raises(Conflict, match=f"was used by video {video.id}"):
        removal.remove(session, "fit", fit_id)
    with stores.database.session() as session:
        removal.remove(session, "video", video.id)
        removal.remove(session, "fit", fit_id)


def moving(stores: Stores, of: str, candidate: int = 0, **arrays: Array) -> tuple[Array, Array]:
    digest = stores.artifacts.put_bytes(npz(**arrays), "motion.npz").sha256
    payload = {"of": of, "scene_id": "scn_1", "source": {"kind": of, "id": "it"}, "motion": digest}
    return task.motion_of(stores, payload, candidate)


def test_the_motion_of_every_kind_of_object_is_found_among_its_arrays(stores: Stores) -> None:
    times, path = np.arange(3) / 30.0, np.random.default_rng(0).normal(size=(2, 3, 5, 3))
    np.testing.assert_array_equal(moving(stores, "model", times=times, tracks=path[0])[0], path[0])
    found, clock = moving(stores, "rollout", 1, times=times, points=path, vertices=path[:, :, :4])
    np.testing.assert_array_equal(found, path[1, :, :4])
    np.testing.assert_array_equal(clock, times)
    np.testing.assert_array_equal(moving(stores, "rollout", times=times, points=path)[0], path[0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"candidate": 2}, "has 2 candidates; there is no candidate 2"),
        ({"times": np.arange(4.0)}, "4 times for 3 frames"),
        ({"points": np.full((2, 3, 5, 3), np.nan)}, "45 numbers that are not finite"),
        ({"points": np.zeros((2, 1, 5, 3)), "times": np.zeros(1)}, r"got \(1, 5, 3\)"),
        (
            {"points": np.zeros((1, 3001, 2, 3)), "times": np.arange(3001.0)},
            "3001 frames; a film has at most 3000",
        ),
    ],
)
def test_a_motion_that_cannot_be_drawn_is_refused_with_its_numbers(
    stores: Stores, change: dict[str, Any], said: str
) -> None:
    given = {"times": np.arange(3) / 30.0, "points": np.zeros((2, 3, 5, 3)), **change}
    with pytest.raises(ValueError, match=said):
        moving(stores, "rollout", given.pop("candidate", 0), **given)
    with pytest.raises(ValueError, match=r"are \['other', 'times'\], none of vertices, points"):
        moving(stores, "rollout", times=np.arange(3.0), other=np.zeros(3))


def test_a_splat_is_fitted_to_the_first_picture_and_kept_beside_the_film(
    runtime_with: RuntimeOf, stores: Stores, scene_id: str
) -> None:
    scene = tiny_scene()
    asked_for = VideoConfig(look="fitted")
    outcome, job, _ = drawn(stores, runtime_with(), asked(stores, scene_id, asked_for))
    assert outcome == "failed" and job.error is not None
    assert "it has no camera.json and no frames.npz" in job.error.detail
    camera = task.camera_of(view())
    grey = gaussians_at_points(scene.points[0], np.full((scene.points.shape[1], 3), 0.3))
    pictures = list(Drawing(scene.points, scene.points[0], camera, grey).frames())
    frames = np.stack([np.round(picture.rgb * 255).astype(np.uint8) for picture in pictures])
    masks = np.stack([picture.alpha > 0.5 for picture in pictures])
    keep(stores, scene_id, "camera.json", view().model_dump_json().encode())
    keep(stores, scene_id, "frames.npz", npz(frames=frames, masks=masks))
    outcome, _, video = drawn(stores, runtime_with(), asked(stores, scene_id, asked_for))
    assert outcome == "done" and video.report is not None and video.report.scores is not None
    assert (video.report.drawn, video.report.seen_from) == ("fitted", "scene")
    assert [item.name for item in video.artifacts] == [FILM, RECORDING, "splat.ply"]
    splat = from_ply(stores.artifacts.read_bytes(video.artifacts[2].sha256))
    assert len(splat) == video.report.gaussians
    assert video.report.scores.iou_per_frame is not None and video.report.scores.iou_per_frame[0] > 0.6
    keep(stores, scene_id, "frames.npz", npz(frames=frames, masks=np.zeros_like(masks)))
    outcome, job, _ = drawn(stores, runtime_with(), asked(stores, scene_id, asked_for))
    assert outcome == "failed" and job.error is not None and "no pixel of the object" in job.error.detail
