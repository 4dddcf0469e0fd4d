"""What people read of one object."""

from __future__ import annotations

import pytest
from physworld_client.cli.output import print_fields
from pydantic import BaseModel


class Thing(BaseModel):
    name: str
    metrics: dict[str, object]


def test_long_curves_are_told_by_their_length(capsys: pytest.CaptureFixture[str]) -> None:
    print_fields(Thing(name="beam", metrics={"track_m": 0.002, "curve": [0.1, None] * 20, "train": [0, 63]}))
    printed = capsys.readouterr().out
    assert '"40 numbers"' in printed
    assert "[0, 63]" in printed
    assert "0.1" not in printed
