"""Following a pipeline: one progress bar per stage on a terminal, plain lines elsewhere.

The pipeline's child jobs are looked at once a second. A service that goes away for less than ``PATIENCE_S``
(a restart) is waited for; the jobs themselves survive it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Protocol

from rich.progress import BarColumn, Progress, TaskID, TextColumn

from physworld_client.cli.output import progress_text, stdout
from physworld_client.cli.report import STAGES, duration_s
from physworld_client.client import Client
from physworld_client.errors import ConnectionFailed
from physworld_client.types import Job
from physworld_schemas.job import TERMINAL_STATES

LOOK_INTERVAL_S = 1.0
LINE_INTERVAL_S = 5.0
PATIENCE_S = 90.0


class View(Protocol):
    """Shows the stages; used as a context manager."""

    def __enter__(self) -> View: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def show(self, stages: dict[str, Job]) -> None:
        """Shows the child jobs as they are now, by stage."""


def follow(
    client: Client, pipeline_id: str, alive: Callable[[], bool], expected: Sequence[str] = STAGES
) -> tuple[Job, dict[str, Job]]:
    """Follows a pipeline to its end; returns it and its child jobs by stage.

    A stage is named by its job's kind; the second of a kind (with the effects that a trace named) is ``kind_2``.

    Args:
        alive: whether a service that this command started still runs.
        expected: stages that are shown before they begin.
    """
    ended: dict[str, Job] = {}
    answered = time.monotonic()
    with _view(expected) as view:
        while True:
            try:
                pipeline = client.jobs.get(pipeline_id)
                stages = dict(ended)
                for child in pipeline.children:
                    if all(job.id != child for job in ended.values()):
                        job = client.jobs.get(child)
                        stage = job.kind if job.kind not in ended else f"{job.kind}_2"
                        stages[stage] = job
                        if job.state in TERMINAL_STATES:
                            ended[stage] = job
                answered = time.monotonic()
            except ConnectionFailed:
                if not alive() or time.monotonic() - answered > PATIENCE_S:
                    raise
                continue
            view.show(stages)
            if pipeline.state in TERMINAL_STATES:
                return pipeline, stages
            time.sleep(LOOK_INTERVAL_S)


def _view(expected: Sequence[str]) -> View:
    return Bars(expected) if stdout.is_terminal else Lines()


class Bars:
    """Rich progress bars, redrawn in place."""

    def __init__(self, expected: Sequence[str]) -> None:
        self._progress = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[state]:<9}"),
            TextColumn("{task.fields[seconds]:>6}"),
            TextColumn("{task.fields[text]}"),
            console=stdout,
        )
        self._tasks: dict[str, TaskID] = {stage: self._add(stage) for stage in expected}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def show(self, stages: dict[str, Job]) -> None:
        """Moves the bars."""
        for kind, job in stages.items():
            if kind not in self._tasks:
                self._tasks[kind] = self._add(kind)
            self._progress.update(
                self._tasks[kind],
                completed=job.share,
                state=job.state,
                seconds=f"{duration_s(job):.0f} s" if job.started_at else "",
                text=progress_text(job),
            )

    def _add(self, stage: str) -> TaskID:
        return self._progress.add_task(stage, total=1.0, state="waiting", seconds="", text="")


class Lines:
    """A line when a stage changes its state, and every few seconds while it moves."""

    def __init__(self) -> None:
        self._printed: dict[str, str] = {}
        self._states: dict[str, str] = {}
        self._last = 0.0

    def __enter__(self) -> Lines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def show(self, stages: dict[str, Job]) -> None:
        """Prints what is new."""
        due = time.monotonic() - self._last >= LINE_INTERVAL_S
        for kind, job in stages.items():
            changed = self._states.get(kind) != job.state
            text = progress_text(job)
            if job.state in TERMINAL_STATES:
                text = f"{duration_s(job):.1f} s{', ' if text else ''}{text}"
            line = f"{kind:<8} {job.state:<11}{text}".rstrip()
            if changed or (due and self._printed.get(kind) != line):
                stdout.print(line, markup=False, soft_wrap=True)
                self._printed[kind] = line
                self._states[kind] = job.state
                self._last = time.monotonic()
