"""Fixtures shared by every test: the measured recordings beside the repository, a free data directory."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# A shell that starts the tests in the background makes them, and every process that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


SERVICE_FOLDERS = ("contract/api", "contract/sdk", "recovery", "system")
"""Of the tests that start a service, or its processes."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what needs a service by the folder it lies in; where processes share the tests, long files come first."""
    folders = [REPOSITORY / "tests" / name for name in SERVICE_FOLDERS]
    for item in items:
        if any(item.path.is_relative_to(folder) for folder in folders):
            item.add_marker("service")
    if hasattr(config, "workerinput"):
        items[:] = _long_files_first(items)


def _long_files_first(items: list[pytest.Item]) -> list[pytest.Item]:
    """Files that wait for services and slow ones that compute, in turn; then quick ones, which fill up both ends."""
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    serving = [tests for tests in files.values() if tests[0].get_closest_marker("service")]
    others = [tests for tests in files.values() if not tests[0].get_closest_marker("service")]
    slow = [tests for tests in others if any(test.get_closest_marker("slow") for test in tests)]
    quick = [tests for tests in others if not any(test.get_closest_marker("slow") for test in tests)]
    in_turn = [tests for pair in zip_longest(serving, slow, fillvalue=[]) for tests in pair]
    return [test for tests in (*in_turn, *quick) for test in tests]


@pytest.fixture(scope="session", autouse=True)
def _own_configuration(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Signing keys that a test comes to know are forgotten with it, also by the processes that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


@pytest.fixture(scope="session")
def repository() -> Path:
    """The repository's root."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured and undeclared scenes; the test is skipped where it is absent."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the measured recordings (../shared/data) are not on this machine")
    return folder


@pytest.fixture(scope="session")
def gpu() -> str:
    """A GPU's name in Warp and torch; the test is skipped where there is none.

    Such tests compare it with the CPU. All others of the simulation run on it where ``PHYSWORLD_DEVICE=cuda:0`` is set.
    """
    import torch
    import warp as wp

    wp.config.quiet = True
    wp.init()
    if not torch.cuda.is_available() or not wp.get_cuda_device_count():
        pytest.skip("no CUDA device on this machine")
    return "cuda:0"
