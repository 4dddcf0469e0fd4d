"""What people stumbled over at the command line and in the SDK; ``scripts/stumbles.py`` has the list."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from physworld_client.cli import output
from physworld_client.cli.lists import RESOURCES
from physworld_client.types import Fit, Job
from typer.testing import CliRunner

AT = datetime(2026, 1, 2, tzinfo=UTC)
FIT_ID = "fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"
SCENE_ID = "scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"


def test_a_list_shows_whole_ids_that_the_next_command_takes() -> None:
    fits = next(one for one in RESOURCES if one.name == "fits")
    fields = {
        "id": FIT_ID,
        "scene_id": SCENE_ID,
        "state": "ready",
        "created_at": AT,
        "job_id": "job_1",
        "config": {},
    }
    listing = fits.lists[0]
    with output.stdout.capture() as captured:
        output.print_table(listing.headings, [listing.row(Fit.model_validate(fields))])
    assert FIT_ID in captured.get()
    assert SCENE_ID in captured.get()


def test_a_fit_whose_search_spent_its_budget_is_not_called_ready() -> None:
    listing = next(one for one in RESOURCES if one.name == "fits").lists[0]
    fields = {"id": FIT_ID, "scene_id": SCENE_ID, "state": "ready", "created_at": AT, "job_id": "job_1"}
    for search, said in (
        ({"converged": False}, "not converged"),
        ({"converged": True}, "ready"),
        (None, "ready"),
    ):
        fit = Fit.model_validate({**fields, "config": {}, "search": search})
        assert listing.row(fit)[listing.headings.index("state")] == said


def test_the_time_left_and_the_share_are_of_the_whole_job() -> None:
    progress = {"done": 3, "total": 40, "unit": "episodes", "fraction": 0.63, "eta_s": 240.0}
    running = Job(id="job_1", kind="pipeline", state="running", created_at=AT, progress=progress)  # type: ignore[arg-type]
    assert output.progress_text(running) == "63 %, about 4 min left, 3 of 40 episodes"


@pytest.mark.parametrize("command", ["fits", "datasets", "models", "keys", "status", "logs", "down"])
def test_every_verb_has_a_page_of_help(command: str) -> None:
    from physworld_client.cli.app import app

    done = CliRunner().invoke(app, [command, "--help"])
    assert done.exit_code == 0
    assert command in done.output
