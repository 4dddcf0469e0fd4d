"""Objects as a person sees them in a shell and in a notebook."""

from __future__ import annotations

from datetime import UTC, datetime

from physworld_schemas.base import Problem
from physworld_schemas.job import Job, Progress


def test_an_object_is_one_short_line() -> None:
    job = Job(
        id="job_01JZ8Q5V3M7X2K9T4B6N8R0C1D",
        kind="fit",
        state="running",
        created_at=datetime(2026, 1, 2, tzinfo=UTC),
        config={"episodes": list(range(500))},
        progress=Progress(done=3, total=12, unit="simulations", message="12.80 mm " * 30),
    )
    shown = repr(job)
    assert shown.startswith("Job(id='job_01JZ8Q5V3M7X2K9T4B6N8R0C1D', kind='fit', state='running'")
    assert len(shown) < 160 and "\n" not in shown and "episodes" not in shown
    assert shown.endswith(", …)") and "Ellipsis" not in shown
    assert "12.80 mm" in repr(job.progress) and len(repr(job.progress)) < 160


def test_a_notebook_gets_a_table_whose_texts_are_escaped() -> None:
    shown = Problem(title="<b>Conflict</b>", status=409, code="conflict")._repr_html_()
    assert "<td>409</td>" in shown and "&lt;b&gt;Conflict" in shown and "<b>" not in shown
