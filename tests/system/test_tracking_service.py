"""The real embedded service makes scenes of pictures: by SDK and command line, cancelled, and past a killed worker."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import robot_logs
from physworld_client import Client
from physworld_client.errors import JobFailed
from scipy.spatial.transform import Rotation
from service_process import ServiceProcess, until
from tracking_pictured import BOTTOM, FRAMES, LEFT, RIGHT, TOP, write

from physworld_scenes.bundle import bundle_from_bytes
from physworld_schemas.tracking import Gripper, TrackingOptions

WITHIN_S = 180.0
CANCELLED_WITHIN_S = 10.0
BOX = (LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8)
PATCH, HELD = (LEFT, TOP, LEFT + 30, BOTTOM), (LEFT, TOP, LEFT + 15, BOTTOM)


def working(service: ServiceProcess) -> list[psutil.Process]:
    """The processes that follow."""
    return [one for one in service.family() if "physworld_workers.tracking_child" in one.cmdline()]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_pictures_become_scenes_by_sdk_and_command_line(tmp_path: Path) -> None:
    folder, arm = tmp_path / "plate", tmp_path / "arm"
    write(folder)
    times = np.arange(FRAMES + 1) / 30.0
    robot_logs.lerobot_info(arm, list(robot_logs.EULER))
    robot_logs.lerobot_file(arm / "data/chunk-000/file-000.parquet", {
        0: (times, np.zeros((len(times), 7))), 1: (times, robot_logs.states_of(times)),
    })  # fmt: skip
    with ServiceProcess(tmp_path / "data", "--workers", "0", "--no-trainer") as service:
        service.start()
        state = service.state()
        key = Path(state["api_key_file"]).read_text().strip()
        with Client(state["api_url"], key, timeout=90.0) as client:
            seen = client.trackings.preview(folder)
            (camera,) = seen.cameras
            assert (camera.frames, camera.media_type) == (FRAMES, "image/png")
            near = client.trackings.preview(folder, TrackingOptions(depth_scale=2000.0))
            assert seen.cloud is not None and near.cloud is not None
            halved = 0.5 * np.asarray(seen.cloud.places_m)
            assert len(halved) > 100 and np.allclose(np.asarray(near.cloud.places_m), halved, atol=2e-3)
            options = TrackingOptions(
                kind="sheet", fps=30.0, up="-y", boxes={0: BOX}, points=40,
                gripper=Gripper(patch=PATCH, held_px=HELD), body={"mass_kg": 0.05},
            )  # fmt: skip
            job = client.jobs.wait(client.trackings.create(folder, options), WITHIN_S)
            told = [str(event.data) for event in client.jobs.events(job.id) if event.type == "progress"]
            scene = client.scenes.get(job.outputs[0].id)
            assert (scene.name, scene.kind, scene.frames, scene.controllers) == ("plate", "sheet", FRAMES, 8)
            assert {"scene.zip", "followed.png"} <= {item.name for item in scene.artifacts}
            assert any(stage in event for event in told for stage in ("reading", "tracking", "gripping")), (
                told
            )

            environment = {**os.environ, "PHYSWORLD_URL": state["api_url"], "PHYSWORLD_TOKEN": key}
            words = [
                "import", str(folder), "--service", "--kind", "sheet", "--rate", "30", "--up", "-y", "--mass", "0.07",
                "--box", ",".join(map(str, BOX)), "--log", str(arm), "--log-episode", "1", "--points", "40",
                "--held", ",".join(map(str, HELD)), "--picture", str(tmp_path / "look.png"), "--keep-pictures",
            ]  # fmt: skip
            command = [str(Path(sys.executable).parent / "physworld"), *words]
            done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
            assert done.returncode == 0, done.stderr
            made = next(one for one in client.scenes.list().data if one.id in done.stdout)
            kept = client.scenes.get(made.id)
            assert kept.declared is not None and kept.declared["body"]["mass_kg"] == 0.07
            assert {"camera.json", "frames.npz"} <= {item.name for item in kept.artifacts}
            archive = next(item for item in kept.artifacts if item.name == "scene.zip")
            there = client.artifacts.download(archive, tmp_path / "kept.zip")
            held = bundle_from_bytes(there.read_bytes())[0].controllers
            places, turns = robot_logs.path_of(times[:FRAMES])
            rotation = Rotation.from_quat(turns[:, [1, 2, 3, 0]])
            inside = rotation[0].inv().apply(held[0] - places[0])
            wanted = np.stack([turn.apply(inside) + at for turn, at in zip(rotation, places, strict=True)])
            assert np.abs(held - wanted).max() < 1e-5  # the log is in float32
            assert (tmp_path / "look.png").read_bytes().startswith(b"\x89PNG")

            with pytest.raises(JobFailed) as caught:
                nowhere = TrackingOptions(boxes={0: (900, 900, 950, 950)}, up="-y")
                client.jobs.wait(client.trackings.create(folder, nowhere), WITHIN_S)
            assert "nothing of the picture of 160 x 120 px" in str(caught.value)

            long = options.model_copy(update={"points": 5000})
            job = client.trackings.create(folder, long)
            until(lambda: bool(working(service)), "the pictures are followed", WITHIN_S)
            started = time.monotonic()
            client.jobs.cancel(job.id)
            until(lambda: client.jobs.get(job.id).state == "cancelled", "it is cancelled", WITHIN_S)
            assert time.monotonic() - started < CANCELLED_WITHIN_S
            until(lambda: not working(service), "nobody follows any more", CANCELLED_WITHIN_S)

            job = client.trackings.create(folder, options.model_copy(update={"name": "survivor"}))
            until(lambda: bool(working(service)), "the pictures are followed", WITHIN_S)
            working(service)[0].parent().kill()  # type: ignore[union-attr]
            scene = client.scenes.get(client.jobs.wait(job, WITHIN_S).outputs[0].id)
            assert scene.name == "survivor"
