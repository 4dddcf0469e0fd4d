"""Declared facts and counts as people read them."""

from __future__ import annotations

from types import SimpleNamespace

from physworld_services.dashboard.site import environment_of_pages
from physworld_services.dashboard.text import plain


def test_what_is_empty_or_open_is_left_out_of_a_line_of_settings() -> None:
    assert (
        plain({"candidates": (), "time_limit_s": None, "seed": 0, "formats": ["onnx"]})
        == "seed 0, formats (onnx)"
    )


def test_a_job_that_is_done_does_not_say_how_many_percent_it_did() -> None:
    counted = environment_of_pages().get_template("macros.html").module.counted
    done = SimpleNamespace(done=90.0, total=100.0, unit="percent")
    assert counted(SimpleNamespace(state="succeeded", progress=done)).strip() == ""
    assert counted(SimpleNamespace(state="running", progress=done)).strip() == "90 %"
