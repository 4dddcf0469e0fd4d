"""What the service answers, with tables and plots: the wire's models and ``to_pandas()`` and ``plot()`` on top.

``physworld_client.types`` is where to import them from. ``plot()`` draws what the answer itself holds, on ``axes`` or a
new figure, and returns the axes; it needs the extra ``plot``, ``to_pandas()`` the extra ``pandas``.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from physworld_client import plots, tables
from physworld_schemas import (
    assessment,
    check,
    dataset,
    fit,
    job,
    key,
    loop,
    model,
    plan,
    rollout,
    scene,
    signing,
    trace,
    video,
)

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes


class Tabled(BaseModel):
    """An answer that is a row of a table."""

    def to_pandas(self) -> pandas.DataFrame:
        """One row: every plain value, nested ones by their path."""
        return tables.to_pandas([self])


class Scene(Tabled, scene.Scene):
    __doc__ = scene.Scene.__doc__


class ScenePreview(Tabled, scene.ScenePreview):
    __doc__ = scene.ScenePreview.__doc__


class Fit(Tabled, fit.Fit):
    __doc__ = fit.Fit.__doc__

    def to_pandas(self) -> pandas.DataFrame:
        """Errors on the held-out frames: a row a predictor, a column a metric."""
        return tables.frame(tables.held_out_rows(self.metrics), "predictor")

    def plot(self, axes: Axes | None = None) -> Axes:
        """Track errors on the held-out frames over time, beside the baselines and the noise floor."""
        return plots.held_out(self.metrics, self.id, axes)


class ModelVersion(Tabled, model.ModelVersion):
    __doc__ = model.ModelVersion.__doc__

    def to_pandas(self) -> pandas.DataFrame:
        """Errors on the held-out frames: a row a predictor, a column a metric, ends of the intervals beside it."""
        return tables.frame(tables.held_out_rows(self.metrics), "predictor")

    def plot(self, axes: Axes | None = None) -> Axes:
        """Track errors on the held-out frames over time, beside twin, baselines and the noise floor."""
        return plots.held_out(self.metrics, f"{self.name} version {self.version}", axes)


class Model(Tabled, model.Model):
    __doc__ = model.Model.__doc__


class ModelComparison(Tabled, model.ModelComparison):
    __doc__ = model.ModelComparison.__doc__

    def to_pandas(self) -> pandas.DataFrame:
        """A row a metric and predictor: both errors and the gain, with their intervals."""
        rows = []
        for one in self.errors:
            row: dict[str, str | float | None] = {"metric": one.metric, "predictor": one.predictor}
            for name, found in (("a", one.a), ("b", one.b), ("gain", one.gain)):
                low, high = (found and found.ci95) or (None, None)
                row |= {name: found.value if found else None, f"{name}.low": low, f"{name}.high": high}
            rows.append(row)
        return tables.frame(rows)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Track errors of both versions with their 95 % intervals."""
        rows = []
        for one in self.errors:
            if one.metric != "track_m" or one.predictor not in plots.PREDICTORS:
                continue
            label, colour, _ = plots.PREDICTORS[one.predictor]
            for number, found in ((self.a, one.a), (self.b, one.b)):
                if found is not None:
                    rows.append((f"{label}, version {number}", found.value, found.ci95, colour))
        return plots.compared(rows, f"{self.name}: version {self.a} and version {self.b}", axes)


class Dataset(Tabled, dataset.Dataset):
    __doc__ = dataset.Dataset.__doc__

    def plot(self, axes: Axes | None = None) -> Axes:
        """Episodes by the pattern of their motion."""
        return plots.bars(self.statistics.get("motions") or {}, self.id, "episodes", axes)


class Episode(Tabled, dataset.Episode):
    __doc__ = dataset.Episode.__doc__


class Trace(Tabled, trace.Trace):
    __doc__ = trace.Trace.__doc__

    def to_pandas(self) -> pandas.DataFrame:
        """The effects that were tried, the best first: what each would account for, and which were selected."""
        return tables.to_pandas(self._ranked())

    def plot(self, axes: Axes | None = None) -> Axes:
        """What each effect would account for beside the threshold, the ten best."""
        ranked = self._ranked()[:10]
        scores = {str(one.get("title") or one["name"]): float(one.get("score") or 0.0) for one in ranked}
        line = ranked[0].get("threshold") if ranked else None
        title = f"{self.id}: {self.verdict or self.state}"
        return plots.bars(scores, title, "share that it would account for", axes, line)

    def _ranked(self) -> list[dict[str, Any]]:
        return sorted(self.candidates, key=lambda one: -(one.get("score") or 0.0))


class Check(Tabled, check.Check):
    __doc__ = check.Check.__doc__

    def to_pandas(self) -> pandas.DataFrame:
        """The effects of the first view: whether a plausible one would be detected, and which multiple of it."""
        views = self.report.views if self.report else []
        return tables.to_pandas(views[0].effects if views else [])


class Assessment(Tabled, assessment.Assessment):
    __doc__ = assessment.Assessment.__doc__

    def plot(self, axes: Axes | None = None) -> Axes:
        """The error on the new recording beside what the card promises, with their 95 % intervals."""
        found = (("promised", self.expected, plots.BEFORE), ("measured", self.measured, plots.AFTER))
        rows = [(label, one.error_m, one.ci95_m, colour) for label, one, colour in found if one is not None]
        return plots.compared(rows, f"{self.name} version {self.version}: {self.outcome or self.state}", axes)


class Loop(Tabled, loop.Loop):
    __doc__ = loop.Loop.__doc__

    def plot(self, axes: Axes | None = None) -> Axes:
        """Errors of both versions on the new recording's held-out frames, with intervals, below the baselines'."""
        rows: list[tuple[str, float, tuple[float, float] | None, str]] = [
            (label, value, None, colour)
            for name, (label, colour, _) in plots.PREDICTORS.items()
            if (value := self.baselines_m.get(name)) is not None
        ]
        for one, colour in ((self.before, plots.BEFORE), (self.after, plots.AFTER)):
            if one is not None:
                figure = one.measured
                rows.append((f"version {one.version}", figure.error_m, figure.ci95_m, colour))
        return plots.compared(rows, f"{self.model}: {self.outcome or self.state}", axes)


class Rollout(Tabled, rollout.Rollout):
    __doc__ = rollout.Rollout.__doc__


class Plan(Tabled, plan.Plan):
    __doc__ = plan.Plan.__doc__


class Video(Tabled, video.Video):
    __doc__ = video.Video.__doc__


class Job(Tabled, job.Job):
    __doc__ = job.Job.__doc__

    def plot(self, axes: Axes | None = None, *, events: Iterable[job.Event] = ()) -> Axes:
        """How long it waited and worked; with ``events=client.jobs.events(job.id)`` the share done over time."""
        title = f"{self.kind} {self.id}: {self.state}"
        told = list(events)
        if told:
            return plots.progress(told, title, axes)
        now = datetime.now(UTC)
        moments = [("waited", self.created_at, self.started_at or self.finished_at or now)]
        if self.started_at is not None:
            moments.append(("worked", self.started_at, self.finished_at or now))
        return plots.spans(moments, title, axes)


class Event(Tabled, job.Event):
    __doc__ = job.Event.__doc__


class ApiKey(Tabled, key.ApiKey):
    __doc__ = key.ApiKey.__doc__


class SigningKey(Tabled, signing.SigningKey):
    __doc__ = signing.SigningKey.__doc__
