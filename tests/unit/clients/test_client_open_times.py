"""Times at which grips are open, as the command line takes them."""

from __future__ import annotations

import pytest
import typer
from physworld_client.cli.predict import open_times


def test_each_grip_has_its_times_and_those_before_it_have_none() -> None:
    assert open_times([]) is None
    assert open_times(["2:0.4,0.7", "0:1,2", "2:0.9,1"]) == [[(1.0, 2.0)], [], [(0.4, 0.7), (0.9, 1.0)]]


@pytest.mark.parametrize("text", ["1", "1:0.2", "a:0.1,0.2", "1:0.1,0.2,0.3", "1:0.1-0.2"])
def test_another_text_is_refused_as_it_is(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="is not GRIP:BEGIN,END"):
        open_times([text])


def test_a_grip_that_cannot_be_is_refused_before_a_list_is_made_for_it() -> None:
    with pytest.raises(typer.BadParameter, match="they are 0 to 99"):
        open_times(["1000000000:0,1"])
    with pytest.raises(typer.BadParameter, match="they are 0 to 99"):
        open_times(["-1:0,1"])
