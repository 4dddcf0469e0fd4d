# Made of async_loop.py by `make sdk`: change that file.
"""Closing the loop: checks of recordings, traces of what a twin leaves, recordings held against published models."""

from __future__ import annotations

from collections.abc import Sequence

from physworld_client.arrays import arrays_of
from physworld_client.base import Listed
from physworld_client.pages import ListPage
from physworld_client.resources import LATEST
from physworld_client.types import Array, Assessment, Check, Job, Loop, Trace
from physworld_schemas.assessment import AssessmentCreate, Frames
from physworld_schemas.check import CheckConfig, CheckCreate
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import TrainingConfig
from physworld_schemas.trace import TraceConfig, TraceCreate


class Checks(Listed):
    """What recordings can show before any fit."""

    resource = "checks"

    def create(self, scene_id: str, config: CheckConfig | None = None) -> Job:
        """Starts a check; its job's output is the check."""
        scene = self._client.scenes.id_of(scene_id)
        body = CheckCreate(scene_id=scene, config=config or CheckConfig())
        return self._send("POST", Job, "checks", body=body)

    def get(self, check_id: str) -> Check:
        """One check: once it is ready, its report."""
        return self._send("GET", Check, "checks", self.id_of(check_id))

    def list(
        self, *, limit: int | None = None, cursor: str | None = None, scene_id: str | None = None
    ) -> ListPage[Check]:
        """Checks, newest first."""
        scene = None if scene_id is None else self._client.scenes.id_of(scene_id)
        return self._page(Check, "checks", cursor=cursor, limit=limit, scene_id=scene)


class Traces(Listed):
    """Residuals traced to effects."""

    resource = "traces"

    def create(
        self,
        scene_id: str,
        config: TraceConfig | None = None,
        *,
        fit: FitConfig | None = None,
        fit_id: str | None = None,
        scene_ids: Sequence[str] = (),
        held_out_scene_ids: Sequence[str] = (),
    ) -> Job:
        """Starts a trace; its job's output is the trace.

        Args:
            scene_id: the recording.
            config: settings of the trace.
            fit: settings of its calibration.
            fit_id: a ready fit whose twin is taken instead, where it fits.
            scene_ids: further recordings of the object, fitted together with the scene.
            held_out_scene_ids: recordings that only the report sees.
        """
        scenes = self._client.scenes
        body = TraceCreate(
            scene_id=scenes.id_of(scene_id),
            scene_ids=[scenes.id_of(one) for one in scene_ids],
            held_out_scene_ids=[scenes.id_of(one) for one in held_out_scene_ids],
            fit_id=None if fit_id is None else self._client.fits.id_of(fit_id),
            config=config or TraceConfig(),
        )
        if fit is not None:
            body = body.model_copy(update={"fit": fit})
        return self._send("POST", Job, "traces", body=body)

    def get(self, trace_id: str) -> Trace:
        """One trace: the verdict and every figure of its report."""
        return self._send("GET", Trace, "traces", self.id_of(trace_id))

    def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        scene_id: str | None = None,
        verdict: str | None = None,
    ) -> ListPage[Trace]:
        """Traces, newest first.

        Args:
            limit: items of a page.
            cursor: ``next_cursor`` of the page before; None: the first page.
            scene_id: only those of this scene.
            verdict: only those with this verdict.
        """
        scene = None if scene_id is None else self._client.scenes.id_of(scene_id)
        return self._page(Trace, "traces", cursor=cursor, limit=limit, scene_id=scene, verdict=verdict)

    def tracks(self, trace_id: str) -> dict[str, Array]:
        """``times`` (T,) [s], ``before`` and ``after`` (T, N, 3) [m]: open-loop tracks without and with the effects."""
        return arrays_of(self._send("GET", bytes, "traces", self.id_of(trace_id), "tracks"))

    def cancel(self, trace_id: str) -> Job:
        """Asks for the end of the trace's job."""
        trace = self.get(trace_id)
        return self._send("POST", Job, "jobs", trace.job_id, "cancel")


class Assessments(Listed):
    """New recordings held against published models."""

    resource = "assessments"

    def create(
        self,
        name: str,
        scene_id: str,
        version: int | str = LATEST,
        *,
        open_trace: bool = True,
        trace: TraceConfig | None = None,
        frames: Frames = "all",
        compared_with: int | None = None,
    ) -> Job:
        """Starts an assessment; its job's outputs are the assessment and the trace that it may open.

        Args:
            name: of the model.
            scene_id: a recording that the version was not made from.
            version: its number, or an alias.
            open_trace: trace the recording where the version errs more than expected.
            trace: settings of that trace; None has the defaults.
            frames: that are scored: "all", or the recording's "held_out" ones alone.
            compared_with: another version of the model, measured on the same frames; None: none.
        """
        body = AssessmentCreate(
            scene_id=self._client.scenes.id_of(scene_id),
            open_trace=open_trace,
            trace=trace or TraceConfig(),
            frames=frames,
            compared_with=compared_with,
        )
        return self._send("POST", Job, "models", name, "versions", version, "assessments", body=body)

    def get(self, assessment_id: str) -> Assessment:
        """One assessment."""
        return self._send("GET", Assessment, "assessments", self.id_of(assessment_id))

    def list(
        self,
        name: str | None = None,
        version: int | str | None = None,
        *,
        limit: int | None = None,
        cursor: str | None = None,
    ) -> ListPage[Assessment]:
        """Assessments, newest first: all of them, those of a model, or those of one version of it.

        Args:
            name: of the model; None: of every model.
            version: number or alias, with ``name``; None: of every version.

        Raises:
            ValueError: a version without a model.
        """
        if version is not None and name is None:
            raise ValueError(f"version {version} of which model? Give its name too")
        if name is None or version is None:
            return self._page(Assessment, "assessments", cursor=cursor, limit=limit, model=name)
        places = ("models", name, "versions", version, "assessments")
        return self._page(Assessment, *places, cursor=cursor, limit=limit)


class Loops(Listed):
    """From a recording that a model predicts badly to the next version of the model."""

    resource = "loops"

    def create(
        self,
        model: str | None = None,
        scene_id: str | None = None,
        version: int | str = LATEST,
        *,
        assessment_id: str | None = None,
        trace: TraceConfig | None = None,
        dataset: DatasetConfig | None = None,
        training: TrainingConfig | None = None,
    ) -> Job:
        """Starts a loop; its id is the job's.

        Args:
            model: name of the model; None with an ``assessment_id``.
            scene_id: a recording that the version was not made from; None with an ``assessment_id``.
            version: its number, or an alias.
            assessment_id: a ready assessment that found the model worse than expected, to go on from.
            trace: settings of the trace; None has the defaults.
            dataset: settings of the demonstrations; None has the version's.
            training: settings of the training; None has the version's.
        """
        recording = None if scene_id is None else self._client.scenes.id_of(scene_id)
        found = None if assessment_id is None else self._client.assessments.id_of(assessment_id)
        body = LoopCreate(
            model=model,
            version=version,
            scene_id=recording,
            assessment_id=found,
            trace=trace or TraceConfig(),
            dataset=dataset,
            training=training,
        )
        return self._send("POST", Job, "loops", body=body)

    def get(self, loop_id: str) -> Loop:
        """One loop: how it ended, what it made, and the errors of both versions."""
        return self._send("GET", Loop, "loops", self.id_of(loop_id))

    def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        model: str | None = None,
        state: str | None = None,
    ) -> ListPage[Loop]:
        """Loops, newest first.

        Args:
            limit: items of a page.
            cursor: ``next_cursor`` of the page before; None: the first page.
            model: only those of the model with this name.
            state: only those whose job is in this state.
        """
        return self._page(Loop, "loops", cursor=cursor, limit=limit, model=model, state=state)
