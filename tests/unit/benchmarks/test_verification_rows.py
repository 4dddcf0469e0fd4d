"""Rows of cases that did not run stay in the document, in the order of the cases."""

from __future__ import annotations

from pathlib import Path

from benchmarks.harness import Report, write_section
from benchmarks.verification.run import CASES, _with_rows_of


def report(rows: list[list[str]]) -> Report:
    header = ["measured", "against", "refined", "resolutions", "errors", "order"]
    return Report(name="verification", title="Verification", figures={}, header=header, rows=rows)


def row(place: int, error: str, mark: str = "") -> list[str]:
    case = CASES[place]
    return [case.title + mark, case.theory, case.refined, "1, 2", error, "2.0"]


def test_a_part_of_the_table_is_renewed_and_the_rest_stays(tmp_path: Path) -> None:
    docs = tmp_path / "page.md"
    write_section(report([row(0, "+1.0e-01"), row(2, "+2.0e-01"), row(3, "+3.0e-01", " **missed**")]), docs)
    new = _with_rows_of(docs, report([row(3, "+4.0e-03"), row(1, "+5.0e-03")]))
    assert [list(line) for line in new.rows] == [
        row(0, "+1.0e-01"),
        row(1, "+5.0e-03"),
        row(2, "+2.0e-01"),
        row(3, "+4.0e-03"),
    ]
    assert _with_rows_of(tmp_path / "none.md", report([row(1, "+1.0e-01")])).rows == [row(1, "+1.0e-01")]
