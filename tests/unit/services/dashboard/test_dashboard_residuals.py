"""Maps of residuals on the pages of a scene and of a version: what they show, and where their pictures lie."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from dashboard_served import Served, demonstrated, work
from PIL import Image
from tiny_scene import register, tiny_scene

from physworld.arrays import Array
from physworld.report.maps import map_png
from physworld.scene import Scene
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingCreate
from physworld_services.stores import Stores
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases

pytestmark = pytest.mark.slow

DRIFT_M = np.array([0.003, 0.0, 0.004])
HIDDEN = (5, 3)  # frame, point


class World:
    """A recording whose twin errs by 5 mm and whose model, made of it, by 10 mm."""

    def __init__(self, database: Database, stores: Stores) -> None:
        self.database, self.stores = database, stores
        scene = tiny_scene()
        visible = scene.visible.copy()
        visible[HIDDEN] = False
        self.scene: Scene = replace(scene, visible=visible)
        self.scene_id = register(self.scene, database, stores.artifacts)
        with database.session() as session:
            fit = jobs.create_fit(session, self.scene_id, FitConfig())
        self.fit_id = fit.outputs[0].id

    def work(self) -> None:
        """Do all that waits."""
        work(self.database, self._result)

    def train(self) -> None:
        """Publish the first version of ``bar``."""
        with self.database.session() as session:
            made = jobs.create_dataset(session, self.fit_id, DatasetConfig(episodes=1))
        self.work()
        with self.database.session() as session:
            jobs.create_training(session, TrainingCreate(name="bar", dataset_id=made.outputs[0].id))
        self.work()

    def _prediction(self, drift: Array) -> list[dict[str, Any]]:
        buffer = io.BytesIO()
        np.savez(buffer, times=self.scene.times, tracks=self.scene.points + drift)
        return [self.stores.artifacts.put_bytes(buffer.getvalue(), "prediction.npz").model_dump()]

    def _result(self, lease: leases.Lease) -> dict[str, Any]:
        return {
            **demonstrated(lease),
            "fit": {"parameters": {}, "metrics": {}, "artifacts": self._prediction(DRIFT_M)},
            "training": {"artifacts": self._prediction(2 * DRIFT_M), "sha256": "c" * 64, "metrics": {}},
        }[lease.kind]


@pytest.fixture
def shown(dashboard: Served) -> tuple[World, httpx.Client]:
    return World(dashboard.database, dashboard.stores), dashboard.client


def pixels(answer: httpx.Response) -> Array:
    assert answer.status_code == 200 and answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_the_map_of_a_scene_is_that_of_its_twin(shown: tuple[World, httpx.Client]) -> None:
    world, client = shown
    place = f"/dashboard/scenes/{world.scene_id}"
    assert "/residuals" not in client.get(place).text, "there is no prediction yet"
    assert client.get(f"{place}/residuals").status_code == 404
    world.work()
    part = f"{place}/residuals?fit={world.fit_id}"
    assert f'data-curve="{part}"' in client.get(place).text
    drawn = client.get(part).text
    for text in ("median 5.00 mm, largest 5.00 mm", "not seen", "5.00 mm</span>", 'class="split"'):
        assert text in drawn, text
    assert "data:" not in drawn, "the policy of the pages lets no such picture in"
    (picture,) = set(re.findall(r'href="([^"]*)"', drawn))
    assert picture == f"{place}/residuals/Twin.png?fit={world.fit_id}"
    seen = pixels(client.get(picture))
    assert seen.shape == (4, len(world.scene.times), 4)
    frame, point = HIDDEN
    assert tuple(seen[3 - point, frame]) == (128, 128, 128, 46), "points upwards, unseen ones grey"
    assert (np.delete(seen[..., 3], frame, axis=1) >= 254).all()
    assert client.get(f"{place}/residuals/Nobody.png").status_code == 404


def test_the_maps_of_a_version_are_in_one_scale_with_its_twin(shown: tuple[World, httpx.Client]) -> None:
    world, client = shown
    world.work()
    world.train()
    place = "/dashboard/models/bar/1"
    assert f'data-curve="{place}/residuals"' in client.get(place).text
    drawn = client.get(f"{place}/residuals").text
    assert "median 10.0 mm" in drawn and "median 5.00 mm" in drawn and drawn.count('class="ramp"') == 1
    model, twin = (pixels(client.get(f"{place}/residuals/{name}.png")) for name in ("World model", "Twin"))
    assert model[0, 0, 3] >= 254 and abs(int(twin[0, 0, 3]) - 255 * 0.5**0.5) < 2
    assert client.get("/dashboard/models/bar/2/residuals").status_code == 404


def test_points_that_share_a_row_show_the_largest_of_them() -> None:
    values = np.zeros((6000, 3))
    values[4321, 1] = 1.0
    seen = np.asarray(Image.open(io.BytesIO(map_png(values, np.arange(3.0), 1.0))))
    assert seen.shape == (600, 3, 4) and (seen[..., 3] > 0).sum() == 1
