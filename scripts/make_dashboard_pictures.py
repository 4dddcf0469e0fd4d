"""``python -m scripts.make_dashboard_pictures [--data FOLDER]``: every page of the dashboard as a picture.

Starts the embedded service on FOLDER (default: a temporary one), lets it make one object of each kind of the two
shipped samples, small ones that take some minutes, and takes each page in a light and in a dark theme, 360 and 1440 px
wide: ``docs/images/dashboard/PAGE-THEME-WIDTH.webp``. A folder that was filled before is not filled again. ``--only``
takes some pages. Needs the extra ``dev`` and a Chromium on this machine.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from physworld_client import Client
from physworld_client.types import (
    TERMINAL_STATES,
    DatasetConfig,
    FitConfig,
    Job,
    PipelineCreate,
    PlanConfig,
    TraceConfig,
    TrainingConfig,
)
from physworld_client.world_model import WorldModel
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from physworld.video import Drawing, eight_bit, whole_motion_view
from physworld_scenes.bundle import canonical_archive, read_bundle

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "images" / "dashboard"
WIDTHS_PX = (360, 1440)
THEMES = ("light", "dark")
TALLEST_PX = 2400  # the rest of a longer page is left out
QUALITY = 62  # of WebP
FILM_PX = (480, 360)
DRAWN_S = 1.5  # for plots and 3D views, once the network is quiet
START_S = 180.0
MODEL = "soft_beam"
LARGER = 1.2
"""Displacements of a recording that the model errs on, relative to those of the one that it was made of."""
STARTS = (
    "pipeline",
    "fit",
    "check",
    "trace",
    "dataset",
    "training",
    "assessment",
    "loop",
    "rollout",
    "video",
    "plan",
)
CHROMIUMS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
PAGES = {
    "login": "/login",
    "overview": "/",
    "job": "/jobs/{job}",
    "job-training": "/jobs/{training}",
    "job-loop": "/jobs/{loop}",
    "job-cancelled": "/jobs/{cancelled}",
    "scenes": "/scenes",
    "upload-refused": "/scenes",
    "scene": "/scenes/{scene}",
    "fits": "/fits",
    "traces": "/traces",
    "trace": "/traces/{trace}",
    "trace-report": "/traces/{trace}/report",
    "assessment": "/assessments/{assessment}",
    "datasets": "/datasets",
    "dataset": "/datasets/{dataset}",
    "models": "/models",
    "model": "/models/{model}",
    "version": "/models/{model}/{version}",
    "playground": "/models/{model}/{version}/playground",
    "compare": "/models/{model}/compare",
    "rollouts": "/rollouts",
    "rollout": "/rollouts/{rollout}",
    "plans": "/plans",
    "plan": "/plans/{plan}",
    "keys": "/keys",
    "audit": "/keys/audit",
    "sessions": "/sessions",
    "tracking": "/trackings",
    "not-found": "/nothing",
} | {f"start-{kind}": f"/start/{kind}" for kind in STARTS}
SMALL_FIT = FitConfig(particle_budget=300, max_simulations=80, numerics=False)
SMALL_TRAINING = TrainingConfig(hidden=16, vertices=40, steps=30)


def main() -> None:
    """Serve, fill, take."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--data", type=Path, default=None, help="data folder of the service (default: temporary)"
    )
    parser.add_argument("--out", type=Path, default=FOLDER, help="where the pictures go")
    parser.add_argument("--only", nargs="*", default=[], help="names of pages, such as scene or start-fit")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="physworld-") as temporary:
        data = options.data or Path(temporary) / "data"
        with service(data) as client:
            fill(client)
            paths = {
                name: path for name, path in pages(client).items() if not options.only or name in options.only
            }
            key = (data / "api-key").read_text().strip()
            options.out.mkdir(parents=True, exist_ok=True)
            total = take(paths, f"{client.base_url}/dashboard", key, options.out)
    print(f"{len(paths) * len(THEMES) * len(WIDTHS_PX)} pictures, {total / 1e6:.1f} MB")


@contextmanager
def service(data: Path) -> Iterator[Client]:
    """The embedded service on a folder, and a client of it."""
    data.mkdir(parents=True, exist_ok=True)
    physworld = Path(sys.executable).with_name("physworld")
    with (data / "up.log").open("w") as log:
        up = subprocess.Popen([physworld, "up", "--data", data, "--workers", "1"], stdout=log, stderr=log)
    try:
        end = time.monotonic() + START_S
        status = [physworld, "status", "--data", data]
        while subprocess.run(status, capture_output=True, check=False).returncode != 0:
            if up.poll() is not None or time.monotonic() > end:
                raise SystemExit((data / "up.log").read_text())
            time.sleep(1.0)
        os.environ |= {"PHYSWORLD_DATA_DIR": str(data), "PHYSWORLD_KNOWN_KEYS": str(data / "known-keys.json")}
        with Client(progress=False) as client:
            yield client
    finally:
        up.terminate()
        up.wait()


def fill(client: Client) -> None:
    """One object of every kind, where there is none yet."""
    beam, rope = (_scene(client, name) for name in (MODEL, "hanging_rope"))
    client.scenes.update(beam, tags=("sample", "simulated"))
    if not client.keys.list().data[1:]:
        client.keys.create("robot-1", "write", expires_in_days=90)
    if not client.checks.list(limit=1).data:
        _wait(client, client.checks.create(beam))
    if not client.models.list(limit=1).data:
        made = PipelineCreate(
            scene_id=beam,
            model_name=MODEL,
            fit=SMALL_FIT,
            dataset=DatasetConfig(episodes=12),
            training=SMALL_TRAINING,
        )
        _wait(client, client.pipelines.create(made))
    if len(client.models.versions(MODEL).data) < 2:
        longer = SMALL_TRAINING.model_copy(update={"steps": 60})
        _wait(client, client.models.create(MODEL, client.datasets.list(limit=1).data[0].id, longer))
        client.models.set_alias(MODEL, "robot", 1)
        client.models.update(MODEL, 1, description="For the laboratory's robot", tags=("lab",))
    if not client.assessments.list(limit=1).data:
        _wait(client, client.assessments.create(MODEL, beam, open_trace=False))
    if not client.traces.list(limit=1).data:
        _wait(client, client.traces.create(rope, TraceConfig(time_limit_s=120, confirmed=3), fit=SMALL_FIT))
    if not client.loops.list(limit=1).data:
        _close_the_loop(client)
    if not client.plans.list(limit=1).data:
        _predict(client)
    if not client.videos.list(limit=1).data:
        _film(client, beam)
    if not client.jobs.list(state="cancelled").data:
        cancelled = client.jobs.cancel(client.fits.create(rope, SMALL_FIT).id)
        while cancelled.state not in TERMINAL_STATES:
            time.sleep(0.2)
            cancelled = client.jobs.get(cancelled.id)


def pages(client: Client) -> dict[str, str]:
    """Addresses of all pages below the dashboard's, by the name of their pictures."""
    jobs = client.jobs.list(limit=100).data
    scenes = {scene.name: scene.id for scene in client.scenes.list().data}
    beam, rope = scenes[MODEL], scenes["hanging_rope"]
    ids = {
        "job": next(job.id for job in jobs if job.kind == "pipeline"),
        "loop": next(job.id for job in jobs if job.kind == "loop"),
        "training": next(job.id for job in jobs if job.kind == "training"),
        "cancelled": next(job.id for job in jobs if job.state == "cancelled"),
        "scene": beam,
        "trace": client.traces.list(scene_id=rope, limit=1).data[0].id,
        "assessment": next(item.id for item in client.assessments.list().data if item.scene_id == beam),
        "dataset": next(item.id for item in client.datasets.list().data if item.scene_id == beam),
        "rollout": client.rollouts.list(limit=1).data[0].id,
        "plan": client.plans.list(limit=1).data[0].id,
        "model": MODEL,
        "version": "2",
    }
    return {name: path.format(**ids) for name, path in PAGES.items()}


def take(paths: dict[str, str], base: str, key: str, out: Path) -> int:
    """Write all pictures; the bytes of them all."""
    total = 0
    with browser() as opened:
        for theme in THEMES:
            context = opened.new_context(color_scheme=theme)  # type: ignore[arg-type]
            context.set_default_timeout(60_000)
            page = context.new_page()
            if "login" in paths:
                total += _both_widths(page, base + paths["login"], out, f"login-{theme}")
            log_in(page, base, key)
            for name, path in paths.items():
                if name != "login":
                    total += _both_widths(page, base + path, out, f"{name}-{theme}")
                    print(f"{name} {theme}", flush=True)
            context.close()
    return total


@contextmanager
def browser() -> Iterator[Browser]:
    """A Chromium that draws 3D views without a graphics card."""
    chromium = next((path for name in CHROMIUMS if (path := shutil.which(name))), None)
    if chromium is None:
        raise SystemExit("no Chromium on this machine (Debian: apt-get install chromium)")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        yield opened
        opened.close()


def log_in(page: Page, base: str, key: str) -> None:
    """Give the key on the page that asks for one."""
    page.goto(f"{base}/login")
    page.fill("#key", key)
    page.click("button[type=submit]")
    page.wait_for_selector(".top nav")


def show(page: Page, address: str, *, refused: bool) -> None:
    """Open a page and wait until its views, curves and bodies are there; ``refused``: after a refused upload."""
    page.goto(address)
    if refused:
        _refuse(page)
    if page.locator("[data-cloud]").count():
        page.wait_for_selector("[data-cloud][data-ready]")
    for curve in page.locator("[data-curve]").all():
        curve.locator(".legend").wait_for()
    if page.locator("[data-playground]").count():
        page.wait_for_selector("[data-playground][data-ready][data-accompanied]")
        page.get_by_label("Twin, live").check()
        page.locator("[data-twin]", has_text="from the model").wait_for()


def _scene(client: Client, name: str) -> str:
    """Id of a shipped scene, uploaded where it is not there."""
    there = [scene.id for scene in client.scenes.list().data if scene.name == name]
    return there[0] if there else client.scenes.create(ROOT / "sample" / name).id


def _wait(client: Client, job: Job) -> None:
    begun = time.monotonic()
    client.jobs.wait(job)
    print(f"{job.kind}: {time.monotonic() - begun:.0f} s", flush=True)


def _close_the_loop(client: Client) -> None:
    """A loop of the beam's first version over its recording with larger displacements, as if that were another one."""
    known = read_bundle(ROOT / "sample" / MODEL)
    start = known.points[:1]
    larger = replace(known, name=f"{MODEL}_larger", points=start + LARGER * (known.points - start))
    with tempfile.TemporaryDirectory() as temporary:
        packed = Path(temporary) / f"{larger.name}.zip"
        packed.write_bytes(canonical_archive(larger))
        scene = client.scenes.create(packed).id
    _wait(client, client.loops.create(MODEL, scene, 1, trace=TraceConfig(time_limit_s=60, confirmed=1)))


def _predict(client: Client) -> None:
    """A rollout and a plan of the newest version: grips that go up by 4 cm, and the free end 3 cm aside."""
    with tempfile.TemporaryDirectory() as temporary:
        client.models.download(MODEL, Path(temporary) / MODEL)
        model = WorldModel.load(Path(temporary) / MODEL)
    frames, start = 60, model.history + 1
    controllers = np.repeat(model.start_controllers[-1:], frames, axis=0)
    controllers[start:, :, 2] += np.minimum(np.arange(frames - start) / 15, 1.0)[:, None] * 0.04
    if not client.rollouts.list(limit=1).data:
        client.rollouts.create(MODEL, controllers, as_job=True)
    points = model.track(model.rollout(controllers))
    end = int(np.argmax(np.linalg.norm(points[0] - controllers[0].mean(axis=0), axis=1)))
    goal = {end: [float(x) for x in points[0, end] + [0.0, 0.03, 0.0]]}
    _wait(client, client.plans.create(MODEL, points=goal, config=PlanConfig(samples=32, iterations=8)))


def _film(client: Client, scene_id: str) -> None:
    """A film of the beam's twin beside pictures of its recording, which has none: they are drawn of its points."""
    points = read_bundle(ROOT / "sample" / MODEL).points
    camera = whole_motion_view(points, -60.0, 20.0, *FILM_PX)
    frames = np.stack([eight_bit(picture) for picture in Drawing(points, points[0], camera).frames()])
    with tempfile.TemporaryDirectory() as temporary:
        seen, drawn = Path(temporary) / "camera.json", Path(temporary) / "frames.npz"
        seen.write_text(json.dumps(asdict(camera) | {"world_to_camera": camera.world_to_camera.tolist()}))
        np.savez_compressed(drawn, frames=frames)
        for path in (seen, drawn):
            client.videos.put_picture(scene_id, path)
    fit = next(fit for fit in client.fits.list().data if fit.scene_id == scene_id and fit.state == "ready")
    _wait(client, client.videos.create("fit", fit.id))


def _refuse(page: Page) -> None:
    """What the form of the page answers to a file that is no recording, sent as a browser without scripts sends it."""
    page.set_input_files(
        "#bundle", {"name": "notes.txt", "mimeType": "text/plain", "buffer": b"no recording"}
    )
    with page.expect_navigation():
        page.evaluate("HTMLFormElement.prototype.submit.call(document.querySelector('[data-upload]'))")


def _both_widths(page: Page, address: str, out: Path, name: str) -> int:
    total = 0
    for width in WIDTHS_PX:
        page.set_viewport_size({"width": width, "height": 900})
        show(page, address, refused=name.startswith("upload-refused"))
        page.wait_for_timeout(1e3 * DRAWN_S)
        for _ in range(2):  # what is as high as a share of the window grows with it
            height = min(TALLEST_PX, int(page.evaluate("document.documentElement.scrollHeight")))
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(500)
        content = page.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height})
        target = out / f"{name}-{width}.webp"
        Image.open(io.BytesIO(content)).convert("RGB").save(target, quality=QUALITY, method=6)
        total += target.stat().st_size
    return total


if __name__ == "__main__":
    main()
