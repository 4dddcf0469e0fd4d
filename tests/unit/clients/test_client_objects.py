"""Answers as tables and plots, the line in which they show themselves, and the one place to import their types from."""

from __future__ import annotations

import inspect
import sys
import typing
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import matplotlib
import numpy as np
import physworld_client
import pytest
from physworld_client import AsyncClient, Client, types
from physworld_client.errors import ExtraMissing, NothingToPlot, PhysWorldError
from physworld_client.pages import AsyncListPage, ListPage
from physworld_client.plots import DWARFS, PREDICTORS
from physworld_client.predictions import Predicted
from physworld_client.types import Dataset, Event, Fit, Job, Loop, ModelComparison, ModelVersion, Scene, Trace
from physworld_client.world_model import WorldModel
from pydantic import BaseModel

from physworld.report import predictors, svg

matplotlib.use("Agg")
AT = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
HELD_OUT = {
    "track_m": {"static": 0.1, "twin": 0.002, "world_model": None},
    "chamfer_l2_m": {"static": 0.2, "twin": 0.004},
    "noise_floor_m": 0.001,
    "frames": [7, 9],
    "ci95": {"track_m": {"twin": [0.001, 0.003]}},
    "per_frame": {
        "frames": [7, 8],
        "times_s": [0.7, 0.8],
        "track_m": {"static": [0.1, 0.1], "twin": [0.001, None]},
    },
}


@pytest.fixture(autouse=True)
def no_figures_left() -> Iterator[None]:
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def fit(**changes: object) -> Fit:
    fields = {
        "id": "fit_1",
        "scene_id": "scn_1",
        "state": "ready",
        "created_at": AT,
        "job_id": "job_1",
        "config": {},
    }
    return Fit.model_validate({**fields, "metrics": {"held_out": HELD_OUT}, **changes})


def version(**changes: object) -> ModelVersion:
    fields = {"name": "beam", "version": 2, "state": "ready", "created_at": AT}
    return ModelVersion.model_validate({**fields, "metrics": {"held_out": HELD_OUT}, **changes})


def job(**changes: object) -> Job:
    fields = {"id": "job_1", "kind": "fit", "state": "succeeded", "created_at": AT}
    moments = {"started_at": AT + timedelta(seconds=2), "finished_at": AT + timedelta(seconds=12)}
    return Job.model_validate({**fields, **moments, **changes})


def trace() -> Trace:
    fields = {"id": "trc_1", "scene_id": "scn_1", "state": "ready", "created_at": AT, "job_id": "job_1"}
    weak = {"name": "drag", "title": "Drag", "score": 0.1, "threshold": 0.3, "selected": False}
    strong = {"name": "lag", "title": "Lag", "score": 0.8, "threshold": 0.3, "selected": True}
    return Trace.model_validate(
        {**fields, "config": {}, "fit": {}, "verdict": "named", "candidates": [weak, strong]}
    )


def dataset(statistics: dict[str, object]) -> Dataset:
    fields = {"id": "dst_1", "fit_id": "fit_1", "scene_id": "scn_1", "state": "sealed", "created_at": AT}
    return Dataset.model_validate({**fields, "job_id": "job_1", "config": {}, "statistics": statistics})


def comparison() -> ModelComparison:
    a, b = {"value": 0.004, "ci95": (0.003, 0.005)}, {"value": 0.002, "ci95": None}
    errors = [{"metric": "track_m", "predictor": "world_model", "a": a, "b": b, "gain": None}]
    fields = {"name": "beam", "a": 1, "b": 2, "same_recording": True, "errors": errors}
    return ModelComparison.model_validate(fields)


@pytest.mark.parametrize("made", [fit, version])
def test_held_out_errors_are_a_table_of_predictors_and_metrics(
    made: typing.Callable[[], Fit | ModelVersion],
) -> None:
    table = made().to_pandas()
    assert list(table.index) == ["static", "twin", "world_model"]
    assert set(table.columns) == {"track_m", "track_m.low", "track_m.high", "chamfer_l2_m"}
    assert table.loc["twin", "track_m"] == 0.002
    assert table.loc["twin", "track_m.high"] == 0.003
    assert np.isnan(table.loc["world_model", "track_m"])


def test_a_page_is_a_table_of_plain_values_with_nested_ones_by_their_path() -> None:
    page = ListPage(
        [job(), job(id="job_2", progress={"fraction": 0.5})], False, None, lambda at: pytest.fail(at)
    )
    table = page.to_pandas()
    assert list(table["id"]) == ["job_1", "job_2"]
    assert table.loc[1, "progress.fraction"] == 0.5
    assert "children" not in table.columns  # a list is no value of a cell
    assert list(physworld_client.to_pandas(page.auto_paging_iter())["id"]) == ["job_1", "job_2"]


def test_a_trace_lists_its_candidates_the_best_first_and_a_comparison_its_intervals() -> None:
    assert list(trace().to_pandas()["name"]) == ["lag", "drag"]
    (row,) = comparison().to_pandas().to_dict("records")
    assert (row["a"], row["a.low"], row["b"]) == (0.004, 0.003, 0.002)
    assert row["b.low"] is None
    assert row["gain"] is None


@pytest.mark.parametrize("made", [fit, version])
def test_errors_are_drawn_in_millimetres_with_the_floor_and_a_logarithm_where_baselines_dwarf(
    made: typing.Callable[[], Fit | ModelVersion],
) -> None:
    axes = made().plot()
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert list(lines) == ["static", "twin", "noise floor"]
    assert lines["static"].get_ydata()[0] == pytest.approx(100.0)
    assert np.isnan(lines["twin"].get_ydata()[1])  # nothing was seen in that frame
    assert lines["noise floor"].get_ydata()[0] == pytest.approx(1.0)
    assert axes.get_yscale() == "log"
    assert made().plot(axes) is axes


def test_traces_comparisons_datasets_and_jobs_are_drawn() -> None:
    assert [text.get_text() for text in trace().plot().get_yticklabels()] == ["Lag", "Drag"]
    rows = [text.get_text() for text in comparison().plot().get_yticklabels()]
    assert rows == ["world model, version 1", "world model, version 2"]
    motions = {"motions": {"lift": 3, "twist": 1}}
    assert [bar.get_width() for bar in dataset(motions).plot().patches] == [3, 1]
    assert [bar.get_width() for bar in job().plot().patches] == [2.0, 10.0]


def test_a_loop_draws_its_baselines_above_both_versions() -> None:
    fields = {"id": "job_1", "model": "bar", "version": 1, "scene_id": "scn_1", "state": "succeeded"}
    figure = {"error_m": 0.018, "ci95_m": [0.012, 0.026], "frames": 36}
    both = {
        "before": {"version": 1, "measured": figure},
        "after": {"version": 2, "measured": {**figure, "error_m": 0.0017, "ci95_m": [0.0014, 0.0021]}},
        "baselines_m": {"rigid_follow": 0.009, "static": 0.01, "constant_velocity": None},
    }
    axes = Loop.model_validate({**fields, "created_at": AT, "outcome": "improved", **both}).plot()
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "static", "rigid follow", "version 1", "version 2",
    ]  # fmt: skip
    points = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(points, [10.0, 9.0, 18.0, 1.7])
    with pytest.raises(NothingToPlot):
        Loop.model_validate({**fields, "created_at": AT}).plot()


def test_a_job_with_its_events_is_the_share_over_time() -> None:
    def event(seconds: float, share: float) -> Event:
        fields = {"seq": 1, "job_id": "job_1", "type": "progress", "at": AT + timedelta(seconds=seconds)}
        return Event.model_validate({**fields, "data": {"fraction": share}})

    (line,) = job().plot(events=[event(0, 0.0), event(5, 0.5)]).get_lines()
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([0.0, 5.0], [0.0, 50.0])


def test_what_has_nothing_to_show_says_so() -> None:
    with pytest.raises(NothingToPlot, match="fit_1 holds nothing to plot yet"):
        fit(metrics={}).plot()
    with pytest.raises(NothingToPlot, match="dst_1"):
        dataset({}).plot()
    assert fit(metrics={}).to_pandas().empty


@pytest.mark.parametrize(
    ("module", "extra", "call"), [("matplotlib.pyplot", "plot", "plot"), ("pandas", "pandas", "to_pandas")]
)
def test_a_missing_package_names_the_extra_that_brings_it(
    module: str, extra: str, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ExtraMissing, match=rf"pip install 'physworld-client\[{extra}\]'") as caught:
        getattr(fit(), call)()
    assert isinstance(caught.value, PhysWorldError)
    assert isinstance(caught.value, ImportError)


def test_predictors_have_the_names_and_colours_of_the_pages() -> None:
    palette = (Path(predictors.__file__).parent / "palette.css").read_text()
    light = palette.partition("@media")[0]
    for name, (label, colour, _) in PREDICTORS.items():
        shown = predictors.PREDICTORS[name]
        assert (shown.label, f"--{shown.role}: {colour};" in light) == (label, True), name
    assert DWARFS == svg.DWARFS


def test_everything_shows_itself_in_one_line() -> None:
    page = ListPage([fit()], True, "next", lambda at: pytest.fail(at))
    assert repr(page) == "<1 Fit, older ones follow>"
    assert repr(AsyncListPage([], False, None, lambda at: pytest.fail(at))) == "<no items>"
    with Client("http://127.0.0.1:1", "key") as client:
        assert repr(client.fits) == "<Fits of http://127.0.0.1:1>"
        assert repr(client.artifacts) == "<Artifacts of http://127.0.0.1:1>"
    for one in (fit(), version(), job(), trace(), dataset({}), comparison()):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 200
    assert "<td>fit_1</td>" in page._repr_html_()


def test_arrays_are_shown_by_their_shapes() -> None:
    model = object.__new__(WorldModel)
    values = {"name": "beam", "version": 3, "rest_vertices": np.zeros((5, 3)), "dt_s": 0.02}
    values |= {"start_controllers": np.zeros((4, 2, 3)), "_network": type("Network", (), {"history": 3})()}
    for name, value in values.items():
        object.__setattr__(model, name, value)
    assert repr(model) == "WorldModel('beam', version=3, vertices=5, controllers=2, history=3, dt_s=0.02)"
    fields = {"model": "beam", "version": 3, "state": "ready", "dt_s": 0.1, "created_at": AT}
    rollout = types.Rollout.model_construct(**fields)
    shown = repr(Predicted(rollout, np.zeros(7), points=np.zeros((1, 7, 9, 3))))
    assert shown == "Predicted('beam', version=3, times=(7,), points=(1, 7, 9, 3))"


def test_every_type_of_the_resources_is_in_the_module_of_types() -> None:
    listed = {getattr(types, name) for name in types.__all__}
    for client in (Client("http://127.0.0.1:1", "key"), AsyncClient("http://127.0.0.1:1", "key")):
        seen = set(_models_of_resources(client))
        assert {Scene, Fit, Job} <= seen
        assert not {found.__name__ for found in seen - listed}


def _models_of_resources(client: Client | AsyncClient) -> Iterator[type[BaseModel]]:
    """Every model that a method of a resource takes or answers, and every model in one of them."""
    waiting: list[object] = []
    for resource in vars(client).values():
        for _, method in inspect.getmembers(type(resource), inspect.isfunction):
            if hasattr(resource, "_client") and not method.__name__.startswith("_"):
                module = vars(sys.modules[method.__module__])
                waiting += [_evaluated(text, module) for text in method.__annotations__.values()]
    met: set[object] = set()
    while waiting:
        hint = waiting.pop()
        if inspect.isclass(hint) and issubclass(hint, BaseModel) and hint not in met:
            met.add(hint)
            waiting += [field.annotation for field in hint.model_fields.values()]
            yield hint
        waiting += typing.get_args(hint)


def _evaluated(text: object, module: dict[str, object]) -> object:
    try:
        return eval(str(text), module)
    except (NameError, TypeError):  # what only a type checker sees: no model of the wire
        return None
