"""Another package adds a law, an effect and a metric, and every part of the system knows them.

The package lies in a folder of its own beside the others on the path, with the entry points that an installation would
write. What is asked runs in fresh processes: registries are filled when they are imported.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

TESTS = Path(__file__).resolve().parents[1]
INIT = '"""Not imported where only the catalogue is read."""\n'
LAW = '''
from dataclasses import dataclass
from typing import Annotated, ClassVar

from physworld.catalogue import Quantity
from physworld.materials.neo_hookean import NeoHookean


@dataclass(frozen=True)
class Foam(NeoHookean):
    """A neo-Hookean law under another name, with a constant that nothing reads."""

    name: ClassVar[str] = "plugin_foam"
    title: ClassVar[str] = "Foam of another package"
    use: ClassVar[str] = "tests"

    pore_size_m: Annotated[float, Quantity("m", "size of the pores", 0.0)] = 1e-3
'''
EFFECT = '''
from dataclasses import dataclass, replace

import numpy as np

from physworld.effects.base import Effect, Strength


@dataclass(frozen=True)
class Updraft(Effect):
    """``lift_m_s2``: an acceleration upwards."""

    name = "plugin_updraft"
    title = "updraft"
    equation = "a = u"
    kind = "force"
    gates = ("lift_m_s2",)

    lift_m_s2: float = 0.0

    @classmethod
    def strengths(cls, twin):
        return (Strength("lift_m_s2", "m/s^2", 0.0, 5.0, 0.05),)

    def problem(self, problem, twin):
        lift = np.array([0.0, 0.0, self.lift_m_s2])
        return replace(problem, gravity_m_s2=np.asarray(problem.gravity_m_s2) + lift)
'''
METRIC = """
import numpy as np

from physworld.evaluate.metrics import Metric


def hits(predicted, measured, visible):
    near = (np.linalg.norm(predicted - measured, axis=-1) < 0.01) & visible
    count = visible.sum(axis=1)
    return np.where(count > 0, near.sum(axis=1) / np.maximum(count, 1), np.nan)


HITS = Metric("plugin_hits", "Hits", "1", "share of visible points within 1 cm", hits, lower_is_better=False)
"""
ENTRY_POINTS = """
[physworld.laws]
plugin_foam = physworld_plugin.foam:Foam
[physworld.effects]
plugin_updraft = physworld_plugin.updraft:Updraft
[physworld.metrics]
plugin_hits = physworld_plugin.hits:HITS
[physworld.catalogue]
physworld_plugin = physworld_plugin
"""


def run(folder: Path, *words: str) -> str:
    """``python`` with these words and the folder on its path; what it prints."""
    path = os.pathsep.join([str(folder), str(TESTS)])
    done = subprocess.run(
        [sys.executable, *words],
        env={**os.environ, "PYTHONPATH": path},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def asked(folder: Path, code: str) -> Any:
    """The JSON on the last line that the code prints."""
    return json.loads(run(folder, "-c", code).splitlines()[-1])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package as it is installed, its catalogue written by our command."""
    folder = tmp_path_factory.mktemp("site")
    package, facts = folder / "physworld_plugin", folder / "physworld_plugin-1.0.dist-info"
    package.mkdir()
    facts.mkdir()
    for name, text in (("__init__", INIT), ("foam", LAW), ("updraft", EFFECT), ("hits", METRIC)):
        (package / f"{name}.py").write_text(text)
    (package / "catalogue.json").write_text("{}")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: physworld-plugin\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(ENTRY_POINTS)
    run(folder, "-m", "physworld_workers.commands.catalogue", "physworld_plugin")
    return folder


def test_its_catalogue_has_what_is_its_own(site: Path) -> None:
    found = json.loads((site / "physworld_plugin" / "catalogue.json").read_text())
    assert [law["name"] for law in found["materials"]] == ["plugin_foam"]
    assert found["materials"][0]["parameters"]["pore_size_m"] == {
        "unit": "m",
        "help": "size of the pores",
        "default": 1e-3,
        "bounds": {"solid": [0.0, None]},
        "gate": False,
    }
    (effect,) = found["effects"]
    assert effect["parameters"]["lift_m_s2"]["bounds"] == {
        shape: [0.0, 5.0] for shape in ("solid", "sheet", "rod")
    }
    assert [metric["name"] for metric in found["metrics"]] == ["plugin_hits"]
    assert found["importers"] == found["exports"] == []


def test_the_library_uses_all_three(site: Path) -> None:
    code = """
import json
import numpy as np
from tiny_scene import tiny_scene
from physworld.effects.registry import effect
from physworld.evaluate.table import held_out_table
from physworld.materials.library import law_class, with_law
from physworld.twin.build import build_twin
scene = tiny_scene()
twin = build_twin(scene, 60)
lifted = twin.with_effect(effect("plugin_updraft", lift_m_s2=3.0))
times = scene.times - scene.times[0]
paths = [one.simulate_nodes(times, scene.controllers, times)[-1, :, 2].mean() for one in (twin, lifted)]
table = held_out_table(scene, {"twin": scene.points})
print(json.dumps({
    "law": with_law(twin.law, "plugin_foam").pore_size_m,
    "same": law_class("plugin_foam", 3).__name__,
    "higher": bool(paths[1] > paths[0]),
    "hits": table["plugin_hits"]["twin"],
    "frames": len(table["per_frame"]["plugin_hits"]["twin"]),
}))
"""
    assert asked(site, code) == {"law": 1e-3, "same": "Foam", "higher": True, "hits": 1.0, "frames": 4}


def test_the_measured_table_has_its_interval(site: Path) -> None:
    code = """
import json
from tiny_scene import tiny_scene
from physworld.evaluate.table import held_out_table
from physworld_services.trainer.measuring import _with_absent, _with_intervals
scene = tiny_scene()
table = _with_absent(_with_intervals(held_out_table(scene, {"twin": scene.points})), ["world_model"])
print(json.dumps([table["ci95"]["plugin_hits"]["twin"], table["plugin_hits"]["world_model"]]))
"""
    assert asked(site, code) == [[1.0, 1.0], None]


def test_the_service_lists_and_takes_them(site: Path, tmp_path: Path) -> None:
    code = f"""
import json, sys
from fastapi.testclient import TestClient
from physworld_services.web import create_app
from physworld_storage.access.api_keys import create_key
from physworld_storage.settings import Settings
app = create_app(Settings(data_dir={str(tmp_path)!r}))
app.state.database.upgrade()
with TestClient(app, base_url="http://127.0.0.1") as client:
    with app.state.database.session() as session:
        token = create_key(session, "test", "admin")[1]
    client.headers["Authorization"] = f"Bearer {{token}}"
    lists = {{
        part: [entry["name"] for entry in client.get(f"/v1/{{part}}").json()["data"]]
        for part in ("materials", "effects", "metrics", "importers", "exports")
    }}
    def post(address, **body):
        scene = "scn_01ARZ3NDEKTSV4RRFFQ69G5FAV"
        return client.post(f"/v1/{{address}}", json={{"scene_id": scene, **body}}).json()
    fits = [post("fits", config={{"law": law}}) for law in ("plugin_foam", "plugin_fog")]
    traces = [post("traces", config={{"candidates": [name]}}) for name in ("plugin_updraft", "plugin_updrift")]
    pipelines = [post("pipelines", fit={{"law": law}}) for law in ("plugin_foam", "plugin_fog")]
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    config = schemas["FitConfig"]["properties"]["law"]
print(json.dumps({{
    "lists": lists,
    "codes": [answer["code"] for answer in (*fits, *traces, *pipelines)],
    "said": fits[1]["errors"],
    "documented": next(option["enum"] for option in config["anyOf"] if "enum" in option),
    "heavy": sorted({{"warp", "torch", "physworld_plugin"}} & set(sys.modules)),
}}))
"""
    found = asked(site, code)
    assert found["lists"]["materials"][-1] == "plugin_foam" and "neo_hookean" in found["lists"]["materials"]
    assert found["lists"]["effects"][-1] == "plugin_updraft"
    assert found["lists"]["metrics"][-1] == "plugin_hits"
    assert {"bundle", "motive", "columns", "rgbd"} <= set(found["lists"]["importers"])
    assert found["lists"]["exports"] == ["npz", "ply", "lerobot"]
    assert found["codes"] == ["not_found", "invalid_request"] * 3
    assert found["said"] == [
        {"loc": ["body", "config", "law"], "msg": "no law 'plugin_fog'; GET /v1/materials lists them"}
    ]
    assert found["documented"][0] == "auto" and found["documented"][-1] == "plugin_foam"
    assert found["heavy"] == []


def test_comparison_pages_and_command_line_show_the_metric(site: Path) -> None:
    code = """
import json
from datetime import UTC, datetime
from physworld_schemas.model import ModelVersion
from physworld_services.dashboard import tables
from physworld_storage.comparison import compare_versions
def version(number, values):
    table = {"plugin_hits": {"twin": sum(values) / 4, "static": 0.25}, "frames": [8, 12],
             "per_frame": {"times_s": [0, 1, 2, 3], "plugin_hits": {"twin": values}}}
    return ModelVersion.model_validate({
        "name": "bar", "version": number, "state": "ready", "job_id": "job", "dataset_id": "d", "fit_id": "f",
        "scene_id": "s", "config": {}, "created_at": datetime.now(UTC), "metrics": {"held_out": table},
    })
a, b = version(1, [0.2, 0.3, 0.4, 0.5]), version(2, [0.6, 0.7, 0.8, 0.9])
errors = {item.predictor: item for item in compare_versions(a, b).errors if item.metric == "plugin_hits"}
table = tables.held_out_of(b.metrics)
print(json.dumps({
    "gain": errors["twin"].gain.value,
    "columns": [column.title for column in tables.held_out_columns(table)],
    "best": {row.label: row.cells[0].best for row in tables.held_out_rows(table)},
}))
"""
    found = asked(site, code)
    assert found["gain"] == pytest.approx(0.4)  # more hits are better
    assert found["columns"] == ["Hits"]
    assert found["best"] == {"Static": False, "Twin": True}
    printed = run(site, "-c", "from physworld_client.cli import main; main()", "catalogue")
    assert "plugin_foam" in printed and "plugin_updraft" in printed and "plugin_hits" in printed
    assert "pore_size_m [m]" in printed
    assert "plugin_updraft" in run(site, "-m", "physworld_workers.commands.effects")


def test_a_name_that_is_taken_is_refused(site: Path, tmp_path: Path) -> None:
    facts = tmp_path / "other-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[physworld.laws]\nhencky = physworld.materials.hencky:Hencky\n")
    with pytest.raises(AssertionError, match="is called 'hencky', which is taken"):
        run(tmp_path, "-c", "import physworld.materials.library")
