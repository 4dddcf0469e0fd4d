"""Every effect of the registry on a solid, a sheet and a rope: a new effect is tried here without a new line."""

from __future__ import annotations

import ast
import io
from dataclasses import fields
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from effect_twins import SCENES, TWINS, simulated

from physworld import trace
from physworld.effects.base import Effect
from physworld.effects.registry import EFFECTS, effect
from physworld.errors import EffectRefused, UnknownEffect
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

CASES = [
    pytest.param(name, body, id=f"{name}-{body}")
    for name, body in product(EFFECTS, SCENES)
    if EFFECTS[name].refuses(TWINS[body]) is None
]
REFUSALS = [(name, body) for name, body in product(EFFECTS, SCENES) if EFFECTS[name].refuses(TWINS[body])]


def at_probe(name: str, body: str) -> Effect:
    """The effect with every gate at its probe."""
    strengths = EFFECTS[name].strengths(TWINS[body])
    return effect(name, **{s.name: s.probe for s in strengths if s.gate})


@cache
def launches(twin_name: str) -> tuple[np.ndarray, int]:
    return counted(TWINS[twin_name], twin_name)


def counted(twin: Twin, body: str) -> tuple[np.ndarray, int]:
    """Nodes of a run and the kernel launches that its graph recorded or ran."""
    count = 0
    launch = wp.launch

    def counting(*arguments: object, **options: object) -> object:
        nonlocal count
        count += 1
        return launch(*arguments, **options)

    wp.launch = counting
    try:
        nodes = simulated(twin, SCENES[body]())
    finally:
        wp.launch = launch
    return nodes, count


@pytest.mark.parametrize("body", SCENES)
def test_all_effects_at_zero_change_no_bit_and_launch_no_kernel(body: str) -> None:
    twin = TWINS[body]
    for name in EFFECTS:
        if EFFECTS[name].refuses(twin) is None:
            twin = twin.with_effect(effect(name))
    assert len(twin.effects) > len(EFFECTS) // 2
    nodes, count = counted(twin, body)
    plain, plain_count = launches(body)
    np.testing.assert_array_equal(nodes, plain)
    assert count == plain_count
    times = SCENES[body]().times
    np.testing.assert_array_equal(twin.observe(nodes, times), TWINS[body].track_nodes(plain))


@pytest.mark.parametrize(("name", "body"), CASES)
def test_an_effect_at_its_probe_shows_and_stays_small(name: str, body: str) -> None:
    twin, times = TWINS[body], SCENES[body]().times
    added = at_probe(name, body)
    assert added.active
    plain = twin.track_nodes(launches(body)[0])
    changed = twin.with_effect(added)
    tracks = changed.observe(simulated(changed, SCENES[body]()), times)
    shown = np.abs(tracks - plain).max()
    assert 1e-8 < shown < 0.05, f"{shown:.3g} m"


@pytest.mark.parametrize(("name", "body"), CASES)
def test_strengths_are_fields_with_bounds_around_their_start(name: str, body: str) -> None:
    kind = EFFECTS[name]
    strengths = kind.strengths(TWINS[body])
    defaults = {f.name: f.default for f in fields(kind)}
    gates = {s.name for s in strengths if s.gate}
    assert gates and gates <= set(kind.gates)
    for strength in strengths:
        assert strength.low <= strength.start <= strength.high and strength.low < strength.high
        assert strength.unit and strength.probe > 0 and strength.start + strength.probe <= strength.high
        assert defaults[strength.name] == (0.0 if strength.gate else strength.start) or (
            not strength.gate and defaults[strength.name] is None
        )
    assert all(defaults[gate] == 0.0 for gate in kind.gates)
    assert not kind().active


@pytest.mark.parametrize(("name", "body"), REFUSALS)
def test_a_refused_effect_is_refused_with_its_reason(name: str, body: str) -> None:
    with pytest.raises(EffectRefused, match=name):
        TWINS[body].with_effect(effect(name))


@pytest.mark.parametrize("body", SCENES)
def test_a_twin_with_effects_goes_through_a_file(body: str) -> None:
    twin = TWINS[body]
    for name, kind in EFFECTS.items():
        if kind.refuses(twin) is None:
            twin = twin.with_effect(at_probe(name, body))
    file = io.BytesIO()
    np.savez(file, **twin.to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = Twin.from_arrays(dict(arrays))
    assert again.effects == twin.effects


def test_a_file_from_before_effects_has_none() -> None:
    arrays = TWINS["rope"].to_arrays()
    text = str(arrays["facts"]).replace(', "effects": []', "")
    assert "effects" not in text
    assert Twin.from_arrays({**arrays, "facts": np.array(text)}).effects == ()


def test_an_effect_takes_the_place_of_one_of_its_name() -> None:
    twin = TWINS["rope"].with_effect(effect("air_drag_linear", rate_per_s=1.0))
    twin = twin.with_effect(effect("gravity_tilt", tilt_x_rad=0.1))
    twin = twin.with_effect(effect("air_drag_linear", rate_per_s=2.0))
    assert twin.effects == (
        effect("air_drag_linear", rate_per_s=2.0), effect("gravity_tilt", tilt_x_rad=0.1)
    )  # fmt: skip


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownEffect, match="air_drag_linear"):
        effect("air_drag")
    with pytest.raises(UnknownEffect, match="rate_per_s"):
        effect("air_drag_linear", rate=1.0)


def _strings(file: Path) -> set[str]:
    """The string constants of a Python file."""
    tree = ast.parse(file.read_text())
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


@pytest.mark.parametrize("file", sorted(Path(trace.__file__).parent.glob("*.py")), ids=lambda file: file.stem)
def test_the_trace_names_no_effect(file: Path) -> None:
    """What a trace knows of an effect stands in the effect's own file."""
    assert _strings(file).isdisjoint(EFFECTS)


def test_an_effect_that_contains_another_one_is_that_with_some_strengths_at_zero() -> None:
    containing = [kind for kind in EFFECTS.values() if kind.contains]
    assert containing
    for kind in containing:
        for name in kind.contains:
            assert set(EFFECTS[name].gates) < set(kind.gates)
