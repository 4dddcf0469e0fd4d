"""What the library lacks: lent to the registry for a recording only, it acts as it says, and names are counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.trace.outside import BODIES, forced, keys, page
from benchmarks.trace.outside_effects import OUTSIDE, Gust, RollingShutter, among_the_known
from benchmarks.trace.power_effects import inject
from benchmarks.trace.power_objects import OBJECTS, observed
from physworld.effects.registry import EFFECTS

pytestmark = pytest.mark.slow


def test_the_registry_holds_them_for_a_recording_only() -> None:
    before = list(EFFECTS)
    with among_the_known():
        assert set(EFFECTS) - set(before) == {kind.name for kind in OUTSIDE}
    assert list(EFFECTS) == before and len(keys()) == len(OUTSIDE) * len(BODIES) * 2


def test_a_gust_acts_while_it_lasts_and_each_moves_by_its_level() -> None:
    rope = OBJECTS["rope"](0)
    without = observed(rope.truth, rope.scene)
    with among_the_known():
        blown = observed(rope.truth.with_effect(Gust(size=2.0)), rope.scene)
        for kind in OUTSIDE:
            made = inject(kind.name, rope, without, 3.0)
            assert made is not None and made.displacement == pytest.approx(3.0, rel=0.2), kind.name
    early = rope.scene.times <= 0.3
    assert np.array_equal(blown[early], without[early])
    first = np.flatnonzero(~early)[1]
    assert (blown - without)[first, -1] @ [0.36, 0.8, 0.48] > 1e-3


def test_a_rolling_shutter_reads_the_lowest_row_last() -> None:
    times = np.linspace(0.0, 1.0, 11)
    tracks = np.zeros((11, 2, 3))
    tracks[:, :, 0], tracks[:, 1, 2] = times[:, None], -1.0
    seen = RollingShutter(size=0.05).measured(times, tracks, OBJECTS["rope"](0).truth)
    assert np.allclose(seen[:-1, 0], tracks[:-1, 0]) and np.allclose(seen[:-1, 1, 0], times[:-1] + 0.05)


def test_a_name_is_forced_but_a_fault_of_the_data_is_the_right_kind_for_a_camera() -> None:
    row = {"object": "beam", "effect": "gust", "level": 3.0, "outcome": "named", "names": ["wind"], "equivalent": [],
           "misfit_before": 3.0, "misfit_after": 1.1, "commit": "abc", "changed": False, "cpu_s": 60.0}  # fmt: skip
    camera = row | {"effect": "rolling_shutter", "outcome": "data_issue", "names": ["measurement_clock"]}
    silent = row | {"object": "rope", "outcome": "unexplained", "names": []}
    assert [forced(r) for r in (row, camera, silent)] == [True, False, False]
    report = page([row, camera, silent])
    assert report.figures["forced"] == 1 and "1 of 3" in report.notes[0]
    text = replace(
        report, machine={"packages": {}, "cpu": "", "cores": 2, "load": 0.0, "python": "", "date": ""}
    )
    assert "| **named: wind (3.0 to 1.1)** |" in text.markdown()
    assert "| unexplained (3.0) |" in text.markdown()
