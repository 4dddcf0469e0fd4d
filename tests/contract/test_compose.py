"""``docker-compose.yml`` against the compose specification, and against our own rules.

``compose_spec.json`` beside this file is the specification's schema (Apache-2.0, compose-spec/compose-spec).
Where a compose binary is installed the file is also put through ``config``; nothing is started.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

pytestmark = pytest.mark.slow

SECRETS = (
    "POSTGRES_PASSWORD",
    "BROKER_PASSWORD",
    "S3_ACCESS_KEY_ID",
    "S3_SECRET_ACCESS_KEY",
    "PHYSWORLD_ADMIN_TOKEN",
    "PHYSWORLD_SIGNING_KEY",
)
ONE_SHOT = {"migrate"}
OURS = {"migrate", "api", "dispatcher", "worker", "trainer", "inference", "planner"}
PINNED = re.compile(r"^[a-z0-9./-]+:v?\d+\.\d+(\.\d+)?([.-][a-z0-9.-]+)?$")
SUBSTITUTION = re.compile(r"(?<!\$)\$\{([A-Z0-9_]+)(:?[-?+])?([^}]*)\}")


@pytest.fixture(scope="module")
def text(repository: Path) -> str:
    """The file as it is committed."""
    return (repository / "docker-compose.yml").read_text()


@pytest.fixture(scope="module")
def services(text: str) -> dict[str, Any]:
    """The services with YAML's anchors merged."""
    return yaml.safe_load(text)["services"]


def test_file_follows_the_compose_specification(text: str) -> None:
    schema = json.loads((Path(__file__).parent / "compose_spec.json").read_text())
    schema.pop("id", None)
    jsonschema.Draft7Validator(schema).validate(yaml.safe_load(_interpolated(text)))


def test_compose_accepts_the_file_and_refuses_it_without_secrets(repository: Path, tmp_path: Path) -> None:
    command = _compose_binary()
    if command is None:
        pytest.skip("no compose binary on this machine")
    (tmp_path / "docker-compose.yml").write_text((repository / "docker-compose.yml").read_text())
    result = _config(command, tmp_path, {})
    assert result.returncode != 0
    assert any(f"set {name}" in result.stderr for name in SECRETS), result.stderr
    result = _config(command, tmp_path, dict.fromkeys(SECRETS, "given"))
    assert result.returncode == 0, result.stderr
    assert set(yaml.safe_load(result.stdout)["services"]) >= OURS


def test_every_secret_is_required_and_has_no_default(text: str) -> None:
    required = set()
    for name, operator, _ in SUBSTITUTION.findall(text):
        if name in SECRETS or re.search(r"PASSWORD|SECRET|TOKEN|ACCESS_KEY|SIGNING_KEY", name):
            assert operator == ":?", f"${{{name}}} can be empty or has a default"
            required.add(name)
    assert required == set(SECRETS)
    literal = re.findall(r"(?im)^\s*[A-Z_]*(?:PASSWORD|SECRET|TOKEN)[A-Z_]*:\s*(?!\$\{)(\S+)", text)
    assert literal == []


def test_example_environment_names_every_secret_and_gives_none(repository: Path, text: str) -> None:
    lines = (repository / ".env.example").read_text().splitlines()
    values = dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))
    assert values == dict.fromkeys(SECRETS, "")
    known = set(values) | {
        line.removeprefix("# ").split("=")[0] for line in lines if re.match(r"# [A-Z0-9_]+=", line)
    }
    assert {name for name, _, _ in SUBSTITUTION.findall(text)} == known


def test_every_service_has_a_health_check_or_runs_once(services: dict[str, Any]) -> None:
    for name, service in services.items():
        if name in ONE_SHOT:
            assert service["restart"] == "no"
            continue
        assert service["healthcheck"]["test"], name
        assert service["restart"] == "unless-stopped", name


def test_services_wait_for_health_not_for_a_start(services: dict[str, Any]) -> None:
    for name, service in services.items():
        for dependency, rule in service.get("depends_on", {}).items():
            wanted = "service_completed_successfully" if dependency in ONE_SHOT else "service_healthy"
            assert rule["condition"] == wanted, f"{name} on {dependency}"


def test_images_are_pinned(services: dict[str, Any], repository: Path) -> None:
    for name, service in services.items():
        assert PINNED.match(service["image"]), f"{name}: {service['image']}"
    default = re.search(r"ARG PYTHON_IMAGE=(\S+)", (repository / "Dockerfile").read_text())
    assert default is not None and PINNED.match(default.group(1))


def test_containers_are_hardened(services: dict[str, Any], repository: Path) -> None:
    for name, service in services.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert not service.get("privileged"), name
    stages = re.split(r"(?m)^FROM ", (repository / "Dockerfile").read_text())[2:]
    for stage in stages:
        assert re.search(r"(?m)^USER 10001:10001$", stage), stage.splitlines()[0]


def test_only_the_web_process_publishes_a_port_and_on_loopback_by_default(services: dict[str, Any]) -> None:
    published = {name: service["ports"] for name, service in services.items() if "ports" in service}
    assert list(published) == ["api"]
    assert published["api"] == ["${PHYSWORLD_BIND:-127.0.0.1}:${PHYSWORLD_API_PORT:-8000}:8000"]


def test_the_web_process_has_no_address_of_the_broker(services: dict[str, Any]) -> None:
    for name in ("api", "migrate"):
        assert not [key for key in services[name]["environment"] if "BROKER" in key]


def test_workers_scale(services: dict[str, Any]) -> None:
    assert "container_name" not in services["worker"]
    assert services["worker"]["deploy"]["replicas"] == "${PHYSWORLD_WORKERS:-2}"


def test_the_threads_of_a_training_reach_the_trainer(services: dict[str, Any]) -> None:
    given = services["trainer"]["environment"]
    assert given["PHYSWORLD_TRAINER_THREADS"] == "${PHYSWORLD_TRAINER_THREADS:-2}"
    assert "OMP_NUM_THREADS" not in given  # it follows from the other


def test_commands_exist_in_their_image(services: dict[str, Any], repository: Path) -> None:
    for name in OURS:
        command, target = services[name]["command"], services[name]["build"]["target"]
        assert command[:2] == ["python", "-m"]
        source = _module_file(repository, command[2])
        assert source.is_file(), f"{name}: {source} is missing"
        assert _has_main(source), f"{source} does nothing when run"
        relative = source.relative_to(repository).as_posix()
        sources = _copied(repository, target)
        assert any(relative == word or relative.startswith(f"{word}/") for word in sources), name
        assert all((repository / word).exists() for word in sources)


def test_the_index_of_packages_reaches_every_stage_that_installs(repository: Path) -> None:
    for stage in re.split(r"(?m)^FROM ", (repository / "Dockerfile").read_text())[1:]:
        before, installs, _ = stage.partition("pip install")
        if installs:  # the classic builder drops an argument at the end of the stage that declares it
            assert "ARG PIP_INDEX_URL" in before and "ARG PIP_EXTRA_INDEX_URL" in before


def test_named_volumes_are_declared(text: str) -> None:
    document = yaml.safe_load(text)
    used = {
        volume.split(":")[0]
        for service in document["services"].values()
        for volume in service.get("volumes", [])
    }
    assert used == set(document["volumes"])


@pytest.mark.parametrize(
    ("target", "modules", "absent"),
    [
        (
            "api",
            "physworld_services.web physworld_services.api.migrate",
            "torch warp celery kombu physworld_workers benchmarks",
        ),
        (
            "worker",
            "physworld_workers.__main__ physworld_workers.dispatcher physworld_workers.app",
            "torch warp physworld_services benchmarks",
        ),
        (
            "trainer",
            "physworld_services.trainer.__main__ physworld_workers.app",
            "torch warp fastapi benchmarks",
        ),
        (
            "inference",
            "physworld_services.inference.__main__ physworld_services.inference.lazy physworld_workers.app",
            "torch warp benchmarks",
        ),
    ],
)
def test_an_image_holds_what_its_process_imports(
    repository: Path, tmp_path: Path, target: str, modules: str, absent: str
) -> None:
    for word, place in _copied(repository, target).items():
        destination = tmp_path / place
        destination.parent.mkdir(parents=True, exist_ok=True)
        if (repository / word).is_dir():
            shutil.copytree(repository / word, destination, ignore=shutil.ignore_patterns("node_modules"))
        else:
            shutil.copy(repository / word, destination)
    program = f"""
import importlib, sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
sys.modules.update(dict.fromkeys({absent.split()!r}))  # importing one of these fails
for name in {modules.split()!r}:
    importlib.import_module(name)
"""
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def _copied(repository: Path, target: str) -> dict[str, str]:
    """What a stage copies: place in the repository to place in the image."""
    stage = (repository / "Dockerfile").read_text().split(f" AS {target}\n")[1].split("\nFROM ")[0]
    places = {}
    for line in re.findall(r"(?m)^COPY (.+)$", stage):
        *sources, goal = line.split()
        for word in sources:
            places[word.rstrip("/")] = goal.rstrip("/") if word.endswith("/") else goal + Path(word).name
    return places


def _interpolated(text: str) -> str:
    """The text with defaults in place of variables, and a word in place of each secret."""
    return SUBSTITUTION.sub(lambda found: found[3] if found[2] == ":-" else "given", text)


def _compose_binary() -> list[str] | None:
    if shutil.which("docker"):
        asked = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        if asked.returncode == 0:
            return ["docker", "compose"]
    return ["docker-compose"] if shutil.which("docker-compose") else None


def _config(command: list[str], folder: Path, secrets: dict[str, str]) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in SECRETS} | secrets
    return subprocess.run(
        [*command, "-f", str(folder / "docker-compose.yml"), "config"],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )


def _module_file(repository: Path, module: str) -> Path:
    """The file of a module: a folder of the repository is imported as ``physworld_FOLDER``."""
    path = repository.joinpath(*module.removeprefix("physworld_").split("."))
    return path / "__main__.py" if path.is_dir() else path.with_suffix(".py")


def _has_main(source: Path) -> bool:
    tree = ast.parse(source.read_text())
    return any(isinstance(node, ast.If) and "__main__" in ast.unparse(node.test) for node in tree.body)
