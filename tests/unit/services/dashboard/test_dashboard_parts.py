"""The dashboard's parts without a browser: points, curves, tables, words, the built files."""

from __future__ import annotations

import hashlib
import html
import json
import re
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from physworld.report.predictors import PREDICTORS
from physworld.scene import Scene
from physworld_services.dashboard import clouds, curves, tables, text
from physworld_services.dashboard.site import HERE, STATIC

NOW = datetime(2030, 5, 4, 12, 0, tzinfo=UTC)


def recording(frames: int = 6, points: int = 4) -> Scene:
    """Points at rest on a line; one of them is hidden in frame 2, everything in frame 3."""
    positions = np.broadcast_to(np.arange(points)[:, None] * np.array([0.1, 0.0, 0.0]), (frames, points, 3))
    visible = np.ones((frames, points), bool)
    visible[2, 1] = False
    visible[3] = False
    return Scene(
        name="line",
        kind="rope",
        points=positions.copy(),
        visible=visible,
        controllers=np.zeros((frames, 1, 3)),
        times=np.arange(frames) / 10.0,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=None,
        train=(0, 4),
        test=(4, frames),
    )


def test_a_hidden_point_is_nan_in_the_buffer() -> None:
    measured = clouds.measured_layers(recording())[0]
    values = np.frombuffer(measured.buffer(), "<f4").reshape(6, 4, 3)
    assert np.isnan(values[2, 1]).all()
    assert np.isnan(values[3]).all()
    assert np.isfinite(values[[0, 1, 4, 5]]).all()


def test_a_layer_too_large_for_a_page_is_thinned_and_says_so() -> None:
    points = np.zeros((400, 5000, 3), np.float32)
    thin = clouds.thinned(clouds.Layer("particles", "Particles", "particles", points))
    assert len(thin.buffer()) <= clouds.LAYER_BYTES
    assert thin.label == f"Particles ({thin.count} of 5000)"


def test_a_prediction_on_another_time_line_takes_the_nearest_frame_and_nothing_beyond_its_end() -> None:
    times = np.array([0.0, 0.2, 0.4])
    points = np.arange(3.0)[:, None, None] * np.ones((1, 1, 3))
    moved = clouds.resampled(points, times, np.array([0.0, 0.09, 0.11, 0.4, 0.59, 0.8]))[:, 0, 0]
    np.testing.assert_array_equal(moved[:5], [0.0, 0.0, 1.0, 2.0, 2.0])
    assert np.isnan(moved[5])


def test_one_frame_can_be_shown() -> None:
    moved = clouds.resampled(np.ones((1, 2, 3)), np.array([0.0]), np.array([0.0, 0.5]))
    assert np.isfinite(moved[0]).all()
    assert np.isnan(moved[1]).all()


def test_the_error_of_a_frame_is_the_mean_over_what_was_visible() -> None:
    scene = recording()
    tracks = scene.points + np.arange(4)[:, None] * np.array([0.0, 0.0, 0.01])
    errors = curves.frame_errors(scene, tracks)
    assert errors[0] == pytest.approx(0.015)
    assert errors[2] == pytest.approx(0.05 / 3)
    assert np.isnan(errors[3])
    [twin] = lines_of(curves.chart(scene.times, {"twin": errors}, split=0.4))
    assert twin["label"] == "twin" and twin["values"][3] is None
    assert twin["values"][0] == pytest.approx(15.0)


def lines_of(plot: str) -> list[dict[str, Any]]:
    """The lines of a plot as its numbers have them."""
    [found] = re.findall(r'data-series="([^"]*)"', plot)
    lines: list[dict[str, Any]] = json.loads(html.unescape(found))
    return lines


def test_an_axis_is_logarithmic_only_where_a_baseline_dwarfs_the_result() -> None:
    times = np.linspace(0.0, 1.0, 5)
    near = {"twin": np.full(5, 0.0018), "rigid_follow": np.full(5, 0.013)}
    far = near | {"constant_velocity": np.full(5, 0.53)}
    linear, logarithmic = (curves.chart(times, errors, floor_m=0.0016) for errors in (near, far))
    zero = ">0</text>"
    # there are two drawings, and in all of them the time axis begins at 0
    assert linear.count(zero) == 2 * 2 and logarithmic.count(zero) == 2
    assert ">100</text>" in logarithmic
    heights = {one["label"]: one["values"][0] for one in lines_of(logarithmic)}
    assert heights == {"rigid follow": 13.0, "constant velocity": 530.0, "twin": 1.8, "noise floor": 1.6}


def test_a_plot_is_drawn_for_wide_and_for_narrow_windows_with_the_same_lines() -> None:
    times = np.linspace(0.0, 1.0, 5)
    plot = curves.chart(times, {"twin": np.full(5, 0.0018)}, split=0.6, floor_m=None)
    drawings = re.findall(r'<svg class="chart (\w+)" viewBox="0 0 (\d+) .*?</svg>', plot)
    assert drawings == [("wide", "980"), ("narrow", "320")]
    assert plot.count('class="line twin"') == 2  # a single line has no legend
    assert plot.count(">held out</text>") == 2


def test_a_predictor_has_one_colour_in_every_plot_and_every_colour_is_in_the_palette() -> None:
    times = np.linspace(0.0, 1.0, 3)
    plot = curves.chart(times, {name: np.ones(3) for name in PREDICTORS}, floor_m=0.5)
    roles = {one["label"]: one["role"] for one in lines_of(plot)}
    assert len(roles) == len(PREDICTORS) + 1
    palette = files("physworld.report").joinpath("palette.css").read_text()
    for role in roles.values():
        assert palette.count(f"--{role}: #") == 2, f"{role} in light and in dark"
        assert f".line.{role} {{ stroke: var(--{role}); }}" in palette


def test_the_curves_of_a_training_need_two_points_and_follow_it() -> None:
    told = [(1.0, {"loss": 1.0, "validation_m": 0.004}), (2.0, {"loss": 0.5, "validation_m": 0.004})]
    assert curves.training_charts(told[:1]) == []
    loss, validation = curves.training_charts(told)
    assert [one["values"] for one in lines_of(loss)] == [[1.0, 0.5]]
    assert [one["values"] for one in lines_of(validation)] == [[4.0, 4.0]]


def test_curves_are_found_where_the_results_table_of_the_library_puts_them() -> None:
    per_frame = {
        "frames": [4, 5],
        "times_s": [0.4, 0.5],
        "track_m": {"static": [0.1, None], "twin": [0.01, 0.02]},
    }
    for metrics in ({"held_out": {"per_frame": per_frame}}, {"per_frame": per_frame}, {"curves": per_frame}):
        found = curves.given_curves(metrics)
        assert found is not None
        assert set(found[1]) == {"static", "twin"}
        assert np.isnan(found[1]["static"][1])
    assert curves.given_curves({"held_out": {}}) is None


def test_the_best_predictor_of_each_metric_is_marked_and_missing_ones_are_not() -> None:
    table = {
        "track_m": {"static": 0.03, "twin": 0.01, "world_model": None},
        "chamfer_l2_m": {"twin": 0.02, "static": 0.01},
        "per_frame": {"frames": []},
        "noise_floor_m": 1e-4,
    }
    assert tables.held_out_of({"held_out": table}) is table
    assert tables.noise_floor_of({"held_out": table}) == 1e-4
    rows = {row.label: row for row in tables.held_out_rows(table)}  # type: ignore[arg-type]
    assert [cell.best for cell in rows["Static"].cells] == [False, True]
    assert [cell.best for cell in rows["Twin"].cells] == [True, False]
    assert [cell.value for cell in rows["World model"].cells] == [None, None]
    assert rows["Static"].baseline
    assert not rows["Twin"].baseline


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, "just now"),
        (59, "59 s ago"),
        (61, "1 min ago"),
        (7300, "2 h ago"),
        (90_000, "1 d ago"),
        (5e6, "2030-03-07"),
    ],
)
def test_ages(seconds: float, words: str) -> None:
    assert text.ago(NOW - timedelta(seconds=seconds), NOW) == words


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (1.84e5, "184,000"),
        (0.45, "0.45"),
        (0.001, "0.001"),
        (1.5e-7, "1.5e-7"),
        (2.0e9, "2e9"),
        (0.0, "0"),
        (-0.0, "0"),
        (7, "7"),
        (None, "–"),
        (True, "yes"),
    ],
)
def test_figures(value: object, words: str) -> None:
    assert text.figure(value) == words


def test_millimetres_keep_three_digits() -> None:
    assert [text.millimetres(value) for value in (0.03, 0.0025, 0.00032, 0.0, -0.0, None)] == [
        "30.0",
        "2.50",
        "0.320",
        "0.00",
        "0.00",
        "–",
    ]


def test_what_people_typed_is_escaped() -> None:
    assert "<b>" not in str(text.identifier("<b>bold</b>"))


def test_the_built_files_belong_to_the_sources() -> None:
    """Fails after a change in frontend/ without ``npm run build`` (README of the dashboard)."""
    digests = json.loads((STATIC / "build.json").read_text())
    sources = {name: hashlib.sha256((HERE / "frontend" / name).read_bytes()).hexdigest() for name in digests}
    assert sources == digests
    present = {f"src/{path.name}" for path in (HERE / "frontend" / "src").iterdir()}
    assert present <= set(digests)


def test_the_lock_file_names_no_registry() -> None:
    assert "resolved" not in (HERE / "frontend" / "package-lock.json").read_text()


def test_no_template_holds_inline_script_or_style() -> None:
    for template in (HERE / "templates").glob("*.html"):
        source = template.read_text()
        for forbidden in ("style=", "<style", "onclick=", "javascript:", "|safe", "<script>"):
            assert forbidden not in source, f"{template.name}: {forbidden}"
