"""The real embedded service draws films: of a recording with pictures and of a rollout, by SDK and command line."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from physworld_client import Client
from published_tiny import publish_tiny, tiny_model
from service_process import ServiceProcess

from physworld.video import gaussians_at_points, orbit_view, to_ply
from physworld_scenes.bundle import bundle_from_bytes
from physworld_schemas.video import CameraView, VideoConfig

WITHIN_S = 180.0


@pytest.mark.slow
def test_films_of_a_recording_and_of_a_rollout_come_from_the_service(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "0", "--no-trainer") as service:
        service.start()
        database, stores = service.stores()
        name, _ = publish_tiny(database, stores.artifacts)
        model = tiny_model()[2]
        state = service.state()
        key = Path(state["api_key_file"]).read_text().strip()
        with Client(state["api_url"], key, timeout=90.0) as client:
            version = client.models.version(name, "latest")
            scene = client.scenes.get(str(version.scene_id))
            archive = next(item for item in scene.artifacts if item.name == "scene.zip")
            recording, _ = bundle_from_bytes(stores.artifacts.read_bytes(archive.sha256))
            camera = orbit_view(recording.points.reshape(-1, 3), 20.0, 15.0, 96, 64)
            view = CameraView(
                width=96, height=64, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
                world_to_camera=camera.world_to_camera.tolist(),
            )  # fmt: skip
            given = {
                "at_rest.ply": to_ply(gaussians_at_points(recording.points[0])),
                "camera.json": view.model_dump_json().encode(),
            }
            for file, content in given.items():
                (tmp_path / file).write_bytes(content)
                client.videos.put_picture(scene.id, tmp_path / file)
            job = client.videos.create("scene", scene.id)
            seen: list[str] = []
            job = client.jobs.wait(job, WITHIN_S, lambda at: seen.append(at.progress.unit))
            assert job.state == "succeeded" and set(seen) == {"frames"}
            film = client.videos.get(job.outputs[0].id)
            assert film.report is not None
            assert (film.report.drawn, film.report.seen_from) == ("splat", "scene")
            path = client.videos.download(film.id, tmp_path / "film.mp4")
            with av.open(io.BytesIO(path.read_bytes())) as opened:
                frames = np.stack([frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)])
            assert frames.shape == (len(recording.times), 64, 96, 3)

            np.savez(tmp_path / "frames.npz", frames=frames)
            environment = {**os.environ, "PHYSWORLD_URL": state["api_url"], "PHYSWORLD_TOKEN": key}

            def physworld(*words: str) -> str:
                command = [str(Path(sys.executable).parent / "physworld"), *words]
                done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
                assert done.returncode == 0, done.stderr
                return done.stdout

            assert "frames.npz" in physworld("scenes", "picture", scene.id, str(tmp_path / "frames.npz"))
            physworld("videos", "add", "scene", scene.id, "--wait")
            (newest, *_) = client.videos.list(scene_id=scene.id).data
            assert newest.report is not None and newest.report.scores is not None
            assert newest.report.scores.ssim > 0.9 and len(newest.report.scores.ssim_per_frame) == len(frames)
            recorded = client.videos.download(newest.id, tmp_path / "recording.mp4", "recording.mp4")
            with av.open(io.BytesIO(recorded.read_bytes())) as opened:
                assert sum(1 for _ in opened.decode(video=0)) == len(frames)
            with pytest.raises(ValueError, match=r"has no recording.mp4: the scene has no pictures"):
                client.videos.download(film.id, tmp_path / "no.mp4", "recording.mp4")
            assert newest.id in physworld("videos", "list", "--of", "scene")
            downloaded = physworld("videos", "download", newest.id, "--out", str(tmp_path / "out"))
            assert "film.mp4" in downloaded and "recording.mp4" in downloaded

            driven = np.repeat(model.start_controllers[-1:], 12, axis=0)
            driven[:3] = model.start_controllers
            predicted = client.rollouts.create(name, driven, as_job=True, timeout=WITHIN_S).rollout
            config = VideoConfig(width=96, height=64)
            drawn = client.jobs.wait(client.videos.create("rollout", str(predicted.id), config), WITHIN_S)
            film = client.videos.get(drawn.outputs[0].id)
            assert film.report is not None and film.report.frames == len(predicted.times)
            assert film.scene_id == scene.id and film.report.scores is None
            assert "a motion of its own" in film.report.not_scored
        database.dispose()
