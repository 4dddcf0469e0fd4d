"""What the processes that answer import: nothing that only other extras bring (``pyproject.toml``)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[4]
ELSEWHERE = (
    "PIL",
    "av",
    "cv2",
    "h5py",
    "matplotlib",
    "mcap",
    "onnx",
    "plyfile",
    "rich",
    "skimage",
    "torch",
    "warp",
)
"""Packages of the extras sim, tables, train and video."""
PROGRAM = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent}:
            raise ImportError(f"{{name}} is not installed here")

sys.meta_path.insert(0, Absent())
import {module}
"""


@pytest.mark.parametrize("module", ["physworld_services.api.parser_process", "physworld_services.web"])
def test_a_process_of_the_api_starts_with_its_extra_alone(module: str) -> None:
    program = PROGRAM.format(absent=set(ELSEWHERE), module=module)
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
