"""The notebooks of the guide run from top to bottom in fresh kernels, and find what their texts say."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
CLAIMS = {
    "recording_to_model": """
assert track["twin"] < 0.5 * track["static"] and track["world_model_finetuned"] < track["static"]
assert 0.03 < lifted < 0.05, lifted
assert np.abs(stiffer[:, far] - vertices[:, far]).mean() > 1e-5
""",
    "missing_effect": """
assert report["verdict"] == "named"
assert [found["name"] for found in report["effects"]] == ["air_drag_linear"]
""",
    "demonstrations": """
assert errors["policy"] < 0.7 * min(errors["stand still"], errors["mean action"]), errors
""",
}


def test_every_notebook_has_its_claims() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == CLAIMS.keys()


@pytest.mark.parametrize("name", CLAIMS)
@pytest.mark.filterwarnings("ignore")  # of the kernel's own libraries
def test_a_notebook_runs_and_keeps_its_word(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in [known for known in os.environ if known.startswith("PHYSWORLD_")]:
        monkeypatch.delenv(variable)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("MPLBACKEND", "agg")
    book = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    book.cells.append(nbformat.v4.new_code_cell(CLAIMS[name]))
    where = {"metadata": {"path": str(FOLDER)}}
    NotebookClient(book, timeout=600, kernel_name="python3", resources=where).execute()
