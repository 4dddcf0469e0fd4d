"""The sample scene, for those who have no recording yet."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

SAMPLE = "soft_beam"
PACKED = ("scene.json", "scene.npz")


def sample_folder() -> Path | None:
    """Where the sample scene lies: in the checkout, or in the package that the wheel carries; None: not here."""
    places = [Path(__file__).resolve().parents[2] / "sample"]
    spec = find_spec("physworld_sample")
    if spec is not None and spec.submodule_search_locations is not None:
        places += map(Path, spec.submodule_search_locations)
    found = (place / SAMPLE for place in places)
    return next((folder for folder in found if all((folder / name).is_file() for name in PACKED)), None)
