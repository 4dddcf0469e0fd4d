"""Names and prefixes, what is started with settings, keys, and the service's own verbs, against the real API."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from physworld_client import Client
from physworld_client.cli.lists import RESOURCES
from physworld_client.cli.names import found
from physworld_client.errors import AuthenticationFailed, PhysWorldError
from sdk_service import Service, write_scene
from test_command_line import output_of, physworld, worker


@pytest.fixture(scope="module")
def scene_id(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("scenes")
    with service.client() as client:
        client.scenes.create(write_scene(folder / "rope", "rope one", seed=1))
        return client.scenes.create(write_scene(folder / "strip", "strip", seed=2)).id


def test_an_object_is_found_by_id_by_the_beginning_of_one_and_by_name(client: Client, scene_id: str) -> None:
    for given in (
        scene_id,
        "strip",
        scene_id[:-1],
        scene_id[:-1].lower(),
        scene_id.removeprefix("scn_")[:-1],
    ):
        assert found(client, "scenes", given) == scene_id
    with pytest.raises(PhysWorldError, match=r"2 scenes fit 'scn_': scn_\w+, scn_\w+"):
        found(client, "scenes", "scn_")
    with pytest.raises(PhysWorldError, match=r"no scene is called 'strap' and no id begins so"):
        found(client, "scenes", "strap")


def test_a_scene_is_tagged_and_found_by_its_tag(
    service: Service, client: Client, scene_id: str, tmp_path: Path
) -> None:
    told = output_of(service, tmp_path, "scenes", "describe", "strip", "--tag", "soft", "--tag", "day 2")
    assert told["tags"] == ["soft", "day 2"]
    listed = output_of(service, tmp_path, "scenes", "list", "--tag", "day 2")
    assert [scene["id"] for scene in listed] == [scene_id]
    assert [scene.id for scene in client.scenes.list(tag="soft").auto_paging_iter()] == [scene_id]
    assert client.scenes.update("strip", tags=()).tags == []
    assert list(client.scenes.list(tag="soft").auto_paging_iter()) == []


def test_a_fit_a_dataset_and_a_model_are_started_with_settings(
    service: Service, scene_id: str, tmp_path: Path
) -> None:
    settings = tmp_path / "fit.json"
    settings.write_text(json.dumps({"max_simulations": 9, "particle_budget": 300}))
    with worker(service):
        fit = output_of(
            service,
            tmp_path,
            "fits",
            "add",
            "strip",
            "--config",
            settings,
            "--particle-budget",
            "200",
            "--wait",
        )
        assert (fit["state"], fit["config"]["max_simulations"], fit["config"]["particle_budget"]) == (
            "succeeded",
            9,
            200,
        )
        fit_id = fit["outputs"][0]["id"]
        done = output_of(service, tmp_path, "datasets", "add", fit_id[:-2], "--episodes", "3", "--wait")
        assert (done["state"], done["config"]["episodes"]) == ("succeeded", 3)
        dataset_id = done["outputs"][0]["id"]
        trained = output_of(
            service, tmp_path, "models", "train", "verbs", dataset_id, "--steps", "7", "--wait"
        )
    assert (trained["state"], trained["config"]["config"]["steps"]) == ("succeeded", 7)
    assert physworld(service, tmp_path, "models", "show", "ver").returncode == 0


def test_another_recording_of_the_object_is_named_as_the_first_is(
    service: Service, client: Client, scene_id: str, tmp_path: Path
) -> None:
    job = output_of(service, tmp_path, "fits", "add", scene_id, "--with", "rope one")
    client.jobs.cancel(job["id"])
    first, second = (item["id"] for item in job["inputs"])
    assert first == scene_id and client.scenes.get(second).name == "rope one"


def test_a_setting_that_there_is_not_names_the_one_that_was_meant(
    service: Service, scene_id: str, tmp_path: Path
) -> None:
    settings = tmp_path / "fit.json"
    settings.write_text('{"max_simulation": 9}')
    done = physworld(service, tmp_path, "fits", "add", scene_id, "--config", settings)
    assert done.returncode == 2
    assert done.stderr == "error: max_simulation: unknown key; did you mean 'max_simulations'?\n"


def test_a_run_takes_a_scene_of_the_service_by_its_name(
    service: Service, scene_id: str, tmp_path: Path
) -> None:
    with worker(service):
        done = physworld(service, tmp_path, "run", "strip", "--episodes", "3", "--name", "byname")
    assert done.returncode == 0, done.stderr
    assert f"scene: strip ({scene_id})" in done.stdout


def test_keys_are_made_listed_and_revoked(service: Service, tmp_path: Path) -> None:
    made = physworld(service, tmp_path, "keys", "create", "robot-1", "--role", "write", "--days", "30")
    token = made.stdout.splitlines()[-1]
    with Client(service.url, token) as robot:
        assert robot.jobs.list(limit=1) is not None
    listed = output_of(service, tmp_path, "keys", "list")
    assert [(key["role"], key["token"]) for key in listed if key["name"] == "robot-1"] == [("write", None)]
    assert physworld(service, tmp_path, "keys", "revoke", "robot-1").returncode == 0
    with (
        Client(service.url, token, max_retries=0) as robot,
        pytest.raises(AuthenticationFailed),
    ):
        robot.jobs.list(limit=1)


def test_a_key_is_rotated_and_its_old_token_lasts_for_the_grace(service: Service, tmp_path: Path) -> None:
    made = physworld(service, tmp_path, "keys", "create", "robot-2")
    old = made.stdout.split()[-1]
    turned = physworld(service, tmp_path, "keys", "rotate", "robot-2", "--grace", "5")
    assert turned.returncode == 0 and "its old token ends 20" in turned.stdout, turned.stderr
    new = turned.stdout.split()[-1]
    assert new != old
    for token in (old, new):
        with Client(service.url, token, max_retries=0) as robot:
            robot.jobs.list(limit=1)
    newest = output_of(service, tmp_path, "keys", "rotate", "robot-2", "--grace", "0")
    for token in (old, new):
        with Client(service.url, token, max_retries=0) as robot, pytest.raises(AuthenticationFailed):
            robot.jobs.list(limit=1)
    with Client(service.url, newest["token"], max_retries=0) as robot:
        robot.jobs.list(limit=1)


def test_the_status_names_what_runs_and_the_jobs(service: Service, scene_id: str, tmp_path: Path) -> None:
    with service.client() as client:
        job = client.fits.create(scene_id)
        told = output_of(service, tmp_path, "status")
        client.jobs.cancel(job.id)
    assert told["running"] and told["api_url"] == service.url
    assert [one["id"] for one in told["jobs"]] == [job.id]
    nothing = physworld(None, tmp_path, "status")
    assert nothing.returncode == 1 and "no service runs on" in nothing.stdout


def test_a_scene_is_checked_without_a_service(tmp_path: Path) -> None:
    good = write_scene(tmp_path / "good")
    bad = write_scene(tmp_path / "bad")
    declared = json.loads((bad / "scene.json").read_text()) | {"kind": "ship"}
    (bad / "scene.json").write_text(json.dumps(declared))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "0.png").write_bytes(b"x")
    done = physworld(None, tmp_path, "scenes", "check", good)
    assert done.returncode == 0 and "20 frames at 30 Hz, 9 points, 1 controllers" in done.stdout
    done = physworld(None, tmp_path, "scenes", "check", good, bad, tmp_path / "pictures", "--json")
    assert done.returncode == 2, done.stderr
    valid, refused, pictures = json.loads(done.stdout)
    assert valid["valid"] and not refused["valid"]
    assert any("kind" in fault for fault in refused["faults"])
    assert "physworld import" in pictures["faults"][-1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("rollout", "beam", "--controllers", "a.npz", "--out", "b.csv"), "it is written as .npz"),
        (("run", "scene", "--json", "report"), "report has no ending; it is written as .json"),
        (("video", "a.npz", "--out", "film.gif"), "film.gif ends in '.gif'; it is written as .mp4"),
        (("trace", "scene", "--out", "a.txt"), "it is written as .json or .html"),
    ],
)
def test_an_output_whose_ending_is_another_forms_is_refused(
    tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    done = physworld(None, tmp_path, *arguments)
    assert done.returncode == 2 and said in " ".join(done.stderr.split())


def test_a_local_file_is_never_called_an_answer_of_the_service(service: Service, tmp_path: Path) -> None:
    (tmp_path / "motion.npz").write_bytes(b"no archive")
    done = physworld(service, tmp_path, "rollout", "beam", "--controllers", "motion.npz", "--out", "b.npz")
    assert done.returncode == 1
    assert done.stderr.startswith("error: motion.npz, 10 bytes, is no npz") and "service" not in done.stderr


def test_every_resource_of_the_table_has_its_list(service: Service, tmp_path: Path) -> None:
    for resource in RESOURCES:
        whose = ("byname",) if resource.lists[0].of else ()
        assert isinstance(output_of(service, tmp_path, resource.name, "list", *whose), list), resource.name


def test_the_shell_is_told_how_to_complete(tmp_path: Path) -> None:
    shell = [
        "bash",
        "-c",
        '"$0" --show-completion && true',
        physworld_command(),
    ]  # it asks which shell began it
    done = subprocess.run(shell, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "_PHYSWORLD_COMPLETE" in done.stdout


def physworld_command() -> str:
    from test_command_line import COMMAND

    return str(COMMAND)
