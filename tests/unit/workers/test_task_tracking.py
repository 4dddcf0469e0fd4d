"""Pictures in the real handler and its process: the scene, what is kept beside it, refusals, cancellation, kills."""

from __future__ import annotations

import io
import os
import signal
import stat
import tarfile
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from planar_filmed import BOARD, Film
from tracking_pictured import BOTTOM, FRAMES, LEFT, NEAR_M, RIGHT, TOP, write

from physworld.video import Renderer, from_ply
from physworld_scenes.bundle import bundle_from_bytes
from physworld_schemas.job import Job
from physworld_schemas.scene import Scene
from physworld_schemas.tracking import TrackingOptions
from physworld_schemas.video import CameraView, VideoCreate
from physworld_storage import resources, videos
from physworld_storage.artifacts import SHA256
from physworld_storage.clock import database_now
from physworld_storage.jobs import jobs, leases
from physworld_storage.jobs.kinds.tracking import forget_uploads
from physworld_storage.tables import JobRow, ShardRow
from physworld_workers import tracking_files
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.stores import Stores
from physworld_workers.tasks import tracking as task
from physworld_workers.tasks.video import camera_of

pytestmark = pytest.mark.slow

RuntimeOf = Callable[..., Runtime]
BOX = [LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8]
OPTIONS: dict[str, Any] = {
    "name": "plate",
    "kind": "sheet",
    "fps": 30.0,
    "up": "-y",
    "body": {"mass_kg": 0.05, "thickness_m": 1e-3},
    "boxes": {"0": BOX},
    "points": 40,
    "gripper": {
        "patch": [LEFT, TOP, LEFT + 30, BOTTOM],
        "held_px": [LEFT, TOP, LEFT + 15, BOTTOM],
    },
}
ENDED_WITHIN_S = 5.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("pictures") / "plate"
    write(made)
    return made


@pytest.fixture(autouse=True)
def nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a tracking writes lies in its folder, which goes with it."""
    place = tmp_path / "tmp"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    monkeypatch.setenv(
        "TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "torch")
    )  # it makes a folder where it is loaded
    yield
    assert list(place.iterdir()) == []


def packed(folder: Path, top: str = "") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, f"{top}{path.relative_to(folder).as_posix()}")
    return buffer.getvalue()


def asked(stores: Stores, data: bytes, options: dict[str, Any], name: str = "take.zip") -> Job:
    upload = stores.artifacts.put_bytes(data, name)
    with stores.database.session() as session:
        return jobs.create_tracking(session, upload, TrackingOptions.model_validate(options))


def worked(stores: Stores, runtime: Runtime, job: Job) -> tuple[str, Job]:
    with stores.database.reading() as session:
        (waiting,) = leases.publishable(session)
    outcome = run_shard(runtime, waiting.shard_id)
    with stores.database.reading() as session:
        return outcome, jobs.get_job(session, job.id)


def scene_made(stores: Stores, job: Job) -> Scene:
    with stores.database.reading() as session:
        return resources.get_scene(session, job.outputs[0].id)


def held(stores: Stores, job: Job) -> list[str]:
    """Digests that the job's shards name."""
    with stores.database.reading() as session:
        rows = session.query(ShardRow).where(ShardRow.job_id == job.id).all()
        return [v for row in rows for v in row.payload.values() if isinstance(v, str) and SHA256.fullmatch(v)]


def test_an_archive_of_pictures_becomes_the_scene_that_the_command_makes(
    runtime_with: RuntimeOf, stores: Stores, folder: Path
) -> None:
    job = asked(stores, packed(folder, "inside/"), OPTIONS | {"keep_pictures": True})
    assert job.kind == "tracking" and job.outputs == [] and len(held(stores, job)) == 1
    outcome, job = worked(stores, runtime_with(), job)
    assert (outcome, job.state) == ("done", "succeeded"), job.error
    scene = scene_made(stores, job)
    assert (scene.name, scene.kind, scene.frames, scene.controllers) == ("plate", "sheet", FRAMES, 8)
    assert job.outputs[0].digest == scene.digest and job.inputs[0].id == "take.zip"
    files = {item.name: stores.artifacts.read_bytes(item.sha256) for item in scene.artifacts}
    assert sorted(files) == ["camera.json", "followed.png", "frames.npz", "scene.zip"]
    with np.load(io.BytesIO(files["frames.npz"])) as kept:
        assert kept["frames"].shape == (FRAMES, 120, 160, 3) and kept["frames"].std() > 10
    recording, _ = bundle_from_bytes(files["scene.zip"])
    # half a metre before the camera; the picture's rows are heights now
    assert np.allclose(recording.points[recording.visible][:, 1], 0.5, atol=2e-3)
    assert recording.declared["body"]["mass_kg"] == 0.05
    assert held(stores, job) == []  # the pictures go with the orphans
    again = asked(stores, packed(folder), OPTIONS)
    _, again = worked(stores, runtime_with(), again)
    assert again.outputs[0].id == job.outputs[0].id  # the same content is the same scene


def test_a_splat_of_the_first_pictures_is_what_films_draw(
    runtime_with: RuntimeOf, stores: Stores, folder: Path
) -> None:
    options = OPTIONS | {"fit_splat": True, "keep_pictures": True}
    outcome, job = worked(stores, runtime_with(), asked(stores, packed(folder), options))
    assert outcome == "done", job.error
    scene = scene_made(stores, job)
    files = {item.name: stores.artifacts.read_bytes(item.sha256) for item in scene.artifacts}
    assert sorted(files) == ["camera.json", "followed.png", "frames.npz", "scene.zip", "splat.ply"]
    camera = camera_of(CameraView.model_validate_json(files["camera.json"]))
    shown = Renderer(camera).render(from_ply(files["splat.ply"]))
    plate = (slice(TOP + 4, BOTTOM - 4), slice(LEFT + 4, RIGHT - 4))
    assert shown.alpha[plate].min() > 0.9 and np.abs(shown.depth[plate] - NEAR_M).max() < 0.01
    with np.load(io.BytesIO(files["frames.npz"])) as kept:
        assert (
            np.mean((shown.rgb[plate] - kept["frames"][0][plate] / 255.0) ** 2) < 10**-2.5
        )  # a PSNR of 25 dB
    with stores.database.session() as session:
        film = jobs.create_video(session, VideoCreate(of="scene", id=scene.id))
    outcome, film = worked(stores, runtime_with(), film)
    assert outcome == "done", film.error
    with stores.database.reading() as session:
        report = videos.get_video(session, film.outputs[0].id).report
    assert report is not None and (report.drawn, report.seen_from) == ("splat", "scene")


def test_a_splat_is_not_promised_of_a_film_without_depth(runtime_with: RuntimeOf, stores: Stores) -> None:
    options = {"fit_splat": True, "plane": {"board": BOARD}}
    _, job = worked(stores, runtime_with(), asked(stores, HOSTILE["film"][0], options))
    assert job.error is not None and job.error.errors[0].loc == ["fit_splat"], job.error


def test_progress_goes_through_the_stages(runtime_with: RuntimeOf, stores: Stores, folder: Path) -> None:
    _, job = worked(stores, runtime_with(), asked(stores, packed(folder), OPTIONS))
    with stores.database.reading() as session:
        told = session.query(JobRow).where(JobRow.id == job.id).one().progress
    assert told["unit"] == "frames" and told["fraction"] == 1.0


def test_a_film_and_a_tar_are_read_too(
    runtime_with: RuntimeOf, stores: Stores, folder: Path, tmp_path: Path
) -> None:
    film = Film()
    box = [int(part) for part in film.box().split(",")]
    options = {"kind": "beam", "boxes": {"0": box}, "plane": {"board": BOARD}, "points": 40}
    options |= {"body": {"thickness_m": 0.004}}
    data = film.write(tmp_path / "strip.mp4").read_bytes()
    _, job = worked(stores, runtime_with(), asked(stores, data, options, "strip.mp4"))
    assert job.state == "succeeded", job.error
    scene = scene_made(stores, job)
    assert scene.name == "strip" and scene.controllers == 0
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        archive.add(folder, "plate")
    _, job = worked(stores, runtime_with(), asked(stores, buffer.getvalue(), OPTIONS, "take.tar.gz"))
    assert job.state == "succeeded", job.error


def zip_of(**members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def linked() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entry = zipfile.ZipInfo("color")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, b"/etc")
    return buffer.getvalue()


HOSTILE = {
    "climbs": (zip_of(**{"../../out.png": b"x"}), "climbs out"),
    "absolute": (zip_of(**{"/etc/passwd": b"x"}), "absolute"),
    "link": (linked(), "is a link or a device"),
    "a file that is a folder": (zip_of(**{"color": b"x", "color/0.png": b"x"}), "cannot be written"),
    "deep": (zip_of(**{"/".join("abcdefghij"): b"x"}), "10 levels deep"),
    "long": (zip_of(**{"n" * 300: b"x"}), "has 300 bytes"),
    "empty": (zip_of(), "holds nothing"),
    "no pictures": (zip_of(**{"scene.json": b"{}"}), "holds scene.json: neither color beside depth"),
    "text": (b"no pictures", "neither a zip nor a tar"),
    "film": (b"\0\0\0\x20ftypisom" + bytes(400), "is missing: a film needs a board or a length"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_fail_the_job_with_the_reason_and_leave_nothing(
    runtime_with: RuntimeOf, stores: Stores, name: str
) -> None:
    data, said = HOSTILE[name]
    outcome, job = worked(stores, runtime_with(), asked(stores, data, OPTIONS))
    assert outcome == "failed" and job.error is not None
    assert job.error.code == "scene_invalid" and said in job.error.errors[0].msg, job.error


def test_a_truncated_archive_and_pictures_of_other_sizes_fail_with_the_numbers(
    runtime_with: RuntimeOf, stores: Stores, folder: Path, tmp_path: Path
) -> None:
    whole = packed(folder)
    _, job = worked(stores, runtime_with(), asked(stores, whole[: len(whole) // 2], OPTIONS))
    assert job.error is not None and "damaged or truncated" in job.error.errors[0].msg
    copy = tmp_path / "copy"
    write(copy)
    (copy / "depth/11.png").unlink()
    _, job = worked(stores, runtime_with(), asked(stores, packed(copy), OPTIONS))
    assert job.error is not None and "11 frames of depth and 12 of colour" in job.error.errors[0].msg
    missing = OPTIONS | {"masks": {"0": "../../etc/passwd"}}
    _, job = worked(stores, runtime_with(), asked(stores, whole, missing))
    assert job.error is not None and job.error.errors[0].msg == "is no file of the archive"
    outside = OPTIONS | {"boxes": {"0": [900, 900, 950, 950]}}
    _, job = worked(stores, runtime_with(), asked(stores, whole, outside))
    assert job.error is not None and "nothing of the picture of 160 x 120 px" in job.error.errors[0].msg


def test_a_bomb_is_refused_before_it_is_unpacked(runtime_with: RuntimeOf, stores: Stores) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("color/0.png", bytes(100 << 20))
    _, job = worked(stores, runtime_with(), asked(stores, buffer.getvalue(), OPTIONS))
    assert job.error is not None and "times are allowed" in job.error.errors[0].msg


def test_what_takes_too_much_memory_or_time_is_refused_with_the_limit(
    runtime_with: RuntimeOf, stores: Stores, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    place = tmp_path / "links"
    place.mkdir()
    monkeypatch.setenv("PYTHONPATH", f"{place}:{os.environ.get('PYTHONPATH', '')}")
    for name, value, said in (
        ("cpu_s", 1, "1 s of processor time"),
        ("memory_bytes", 1, "1 bytes of memory"),
    ):
        (place / "sitecustomize.py").write_text(
            "import dataclasses, physworld_workers.tracking_files as f\n"
            f"f.LIMITS = dataclasses.replace(f.LIMITS, {name}={value})\n"
        )
        limits = replace(tracking_files.LIMITS, **{name: value})
        monkeypatch.setattr(tracking_files, "LIMITS", limits)
        _, job = worked(stores, runtime_with(), asked(stores, packed(folder), OPTIONS))
        assert job.error is not None and said in job.error.errors[0].msg, job.error


def children() -> list[psutil.Process]:
    found = psutil.Process().children(recursive=True)
    return [one for one in found if "physworld_workers.tracking_child" in one.cmdline()]


def test_a_cancelled_job_ends_at_once_and_lets_its_pictures_go(
    runtime_with: RuntimeOf, stores: Stores, folder: Path
) -> None:
    job = asked(stores, packed(folder), OPTIONS | {"points": 2000})
    ended: list[float] = []

    def cancel() -> None:
        while not children():
            time.sleep(0.02)
        with stores.database.session() as session:
            jobs.cancel_job(session, job.id)
        ended.append(time.monotonic())

    thread = threading.Thread(target=cancel)
    thread.start()
    outcome, job = worked(stores, runtime_with(), job)
    thread.join()
    assert outcome == "cancelled" and job.state == "cancelled" and children() == []
    assert time.monotonic() - ended[0] < ENDED_WITHIN_S
    assert held(stores, job) == []


def test_a_child_that_is_killed_is_told_and_a_retry_finds_the_pictures(
    runtime_with: RuntimeOf, stores: Stores, folder: Path
) -> None:
    job = asked(stores, packed(folder), OPTIONS)

    def kill() -> None:
        while not children():
            time.sleep(0.02)
        children()[0].send_signal(signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    outcome, job = worked(stores, runtime_with(), job)
    thread.join()
    assert outcome == "failed" and job.error is not None and "more memory" in job.error.errors[0].msg
    with stores.database.session() as session:
        jobs.retry_job(session, job.id)
    left = Path(tempfile.gettempdir()) / f"physworld-tracking-{_shard_id(stores, job)}"
    (left / "pictures").mkdir(parents=True)  # of an attempt whose worker was killed
    outcome, job = worked(stores, runtime_with(), job)
    assert (outcome, job.state) == ("done", "succeeded"), job.error


def test_pictures_of_a_job_that_failed_long_ago_are_let_go(runtime_with: RuntimeOf, stores: Stores) -> None:
    _, job = worked(stores, runtime_with(), asked(stores, b"no pictures", OPTIONS))
    with stores.database.session() as session:
        now = database_now(session)
        assert forget_uploads(session, now - timedelta(days=1)) == 0
        assert forget_uploads(session, now + timedelta(days=1)) == 1
        assert forget_uploads(session, now + timedelta(days=1)) == 0
        jobs.retry_job(session, job.id)
    _, job = worked(stores, runtime_with(), job)
    assert job.error is not None and job.error.detail == "take.zip is no longer kept; upload it again"


def _shard_id(stores: Stores, job: Job) -> str:
    with stores.database.reading() as session:
        return str(session.query(ShardRow).where(ShardRow.job_id == job.id).one().id)


def test_the_handler_holds_no_key_out_to_its_process() -> None:
    assert "PHYSWORLD_TOKEN" not in task.environment() and "HOME" in task.environment()
