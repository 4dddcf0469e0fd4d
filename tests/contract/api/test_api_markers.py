"""Tables of markers through the REST API: what would be guessed, then the scene, with the options of ``physworld
import``.
"""

from __future__ import annotations

import json

import httpx
import marker_files as files
import numpy as np
import pytest
from api_service import assert_problem, upload

MOTION = files.made(frames=60)
FACTS = {"kind": "sheet", "body": {"mass_kg": 0.08, "thickness_m": 1e-3, "side_m": 0.4}}


def preview(client: httpx.Client, data: bytes, name: str, options: dict[str, object]) -> httpx.Response:
    return client.post(
        "/v1/scenes/preview", files={"bundle": (name, data)}, data={"options": json.dumps(options)}
    )


def test_a_preview_says_what_would_be_guessed_and_stores_nothing(client: httpx.Client) -> None:
    before = len(client.get("/v1/scenes", params={"limit": 200}).json()["data"])
    found = preview(client, files.columns(MOTION, up="y", unit="mm"), "tracks.csv", {})
    assert found.status_code == 200, found.text
    body = found.json()
    assert body["importer"] == "plain columns of numbers"
    values = {guess["option"]: guess["value"] for guess in body["guesses"]}
    assert (values["up"], values["unit"], values["fps"]) == ("y", "mm", "100 Hz")
    assert "up is guessed to be y: --up says it" in body["lines"]
    markers = {one["name"]: one for one in body["markers"]}
    assert (
        len(markers) == 20 and markers["grip1"]["roles"] == ["gripper"] and markers["m1"]["roles"] == ["body"]
    )
    assert np.allclose(markers["grip1"]["place_m"], MOTION.gripper[0, 0], atol=1e-6)
    assert body["axes"] == [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]  # the file's y points up
    assert len(client.get("/v1/scenes", params={"limit": 200}).json()["data"]) == before


@pytest.mark.parametrize(
    ("write", "name", "options"),
    [
        (files.motive, "take.csv", {"importer": "motive", "controllers": ["Gripper"]}),
        (files.vicon, "trial.csv", {"up": "z", "unit": "mm"}),
        (files.qualisys, "trial.tsv", {"fps": 100.0}),
        (files.trc, "trial.trc", {"markers": ["M*"]}),
        (files.npz, "tracks.npz", {}),
        (files.mcap_json, "log.mcap", {}),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_tables_become_scenes_with_their_options(
    client: httpx.Client, write: object, name: str, options: dict[str, object]
) -> None:
    data = write(MOTION)  # type: ignore[operator]
    made = upload(client, data, name, options=json.dumps(FACTS | {"assume": False} | options))
    assert made.status_code == 201, made.text
    scene = made.json()
    assert (scene["points"], scene["frames"], scene["controllers"]) == (16, 60, 4)
    assert scene["fps"] == pytest.approx(100.0)
    assert [guess["what"] for guess in scene["declared"]["notes"]["guessed"]][:3] == ["up", "unit", "rate"]


def test_what_is_missing_is_said_or_left_open(client: httpx.Client) -> None:
    data = files.motive(MOTION, version="1.24")
    problem = assert_problem(
        upload(client, data, "take.csv", options='{"assume": false}'), 422, "scene_invalid"
    )
    assert "its kind" in problem["errors"][0]["msg"] and "--mass KG" in problem["errors"][0]["msg"]
    made = upload(client, data, "take.csv", options='{"kind": "sheet"}')
    assert made.status_code == 201
    assert any(warning.startswith("left open: its mass or density") for warning in made.json()["warnings"])


def test_hostile_tables_are_refused_within_the_limits(client: httpx.Client) -> None:
    hostile = {
        "wide.csv": b"time," + b",".join(b"m%d" % i for i in range(32_000)) + b"\n",
        "long.csv": b"time,a_x,a_y,a_z\n" + b"," * 250_000,
        "forged.h5": b"\x89HDF\r\n\x1a\n"
        + bytes(np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8)),
        "forged.mcap": b"\x89MCAP0\r\n" + b"\xff" * 4000,
    }
    for name, data in hostile.items():
        assert assert_problem(upload(client, data, name), 422, "scene_invalid")["errors"], name
        assert assert_problem(preview(client, data, name, {}), 422, "scene_invalid")["errors"], name
    named = preview(client, files.trc(MOTION), "a.trc", {"importer": "vicon"})
    assert (
        "the rate of the section Trajectories"
        in assert_problem(named, 422, "scene_invalid")["errors"][0]["msg"]
    )
    unknown = preview(client, files.trc(MOTION), "a.trc", {"importer": "nobody"})
    assert "known are npz, bundle" in assert_problem(unknown, 422, "scene_invalid")["errors"][0]["msg"]
