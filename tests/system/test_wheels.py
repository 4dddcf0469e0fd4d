"""Both distributions built, installed into an empty environment without a network, and used on the sample scene."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

FOLDERS = {
    "physworld": "physworld",
    "physworld_client": "clients/python/physworld_client",
    "physworld_sample": "sample",
    "physworld_scenes": "scenes",
    "physworld_schemas": "schemas",
    "physworld_services": "services",
    "physworld_storage": "storage",
    "physworld_workers": "workers",
}
SMALL = (
    "--episodes",
    "2",
    "--simulations",
    "4",
    "--steps",
    "5",
    "--vertices",
    "20",
    "--hidden",
    "8",
    "--particles",
    "200",
)
UNPACKED = shutil.ignore_patterns("__pycache__", "node_modules", "*.egg-info", "build")
WHERE = "import importlib, json, sys; print(json.dumps([importlib.import_module(n).__file__ for n in sys.argv[1:]]))"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment that holds the two wheels; other packages are found where these tests find them.

    The line of a ``.pth`` file only adds a folder: the ``.pth`` files in that folder, by which the repository is
    installed as editable, are not read.
    """
    root = Path(__file__).resolve().parents[2]
    base = tmp_path_factory.mktemp("wheels")
    source, environment = base / "source", base / "environment"
    for folder in (*(name for name in FOLDERS.values() if "/" not in name), "clients"):
        shutil.copytree(root / folder, source / folder, ignore=UNPACKED)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(root / name, source / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--no-input", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-index"]
    built = [str(source), str(source / "clients" / "python"), "--wheel-dir", str(base / "wheels")]
    subprocess.run([*pip, "wheel", *offline, "--no-build-isolation", *built], check=True, cwd=base)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    wheels = [str(wheel) for wheel in (base / "wheels").iterdir()]
    python = ["--python", str(environment / "bin" / "python")]
    subprocess.run([*pip, *python, "install", *offline, *wheels], check=True, cwd=base)
    packages = next(environment.glob("lib/python*/site-packages"))
    taken = {path.name for path in packages.iterdir() if path.suffix not in {".dist-info", ".pth"}}
    assert taken == FOLDERS.keys()
    (packages / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment


def outside(data: Path) -> dict[str, str]:
    """An environment that leads neither to the repository nor to another service."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PHYSWORLD_") and k != "PYTHONPATH"}
    return {**kept, "OMP_NUM_THREADS": "1", "XDG_CONFIG_HOME": str(data / "config")}


def test_every_package_is_typed_and_whole(installed: Path, repository: Path) -> None:
    packages = next(installed.glob("lib/python*/site-packages"))
    for name, folder in FOLDERS.items():
        assert (packages / name / "py.typed").is_file()
        for path in (repository / folder).rglob("*"):
            place = path.relative_to(repository / folder)
            ours = path.is_file() and "__pycache__" not in place.parts and path.name != "README.md"
            if ours and not {"frontend", "python"} & set(place.parts):
                assert (packages / name / place).is_file(), f"{name} lacks {place}"


def test_the_sample_scene_runs_with_what_was_installed(
    installed: Path, repository: Path, tmp_path: Path
) -> None:
    python = installed / "bin" / "python"
    asked = [str(python), "-c", WHERE, *FOLDERS]
    found = subprocess.run(
        asked, cwd=tmp_path, env=outside(tmp_path), capture_output=True, text=True, check=True
    )
    assert all(Path(file).is_relative_to(installed) for file in json.loads(found.stdout))

    report = tmp_path / "report.json"
    command = [str(installed / "bin" / "physworld"), "run", str(repository / "sample" / "soft_beam"), *SMALL]
    command += ["--data", str(tmp_path / "data"), "--json", str(report)]
    done = subprocess.run(
        command, cwd=tmp_path, env=outside(tmp_path), capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"twin", "world_model"} <= json.loads(report.read_text())["held_out"]["track_m"].keys()
