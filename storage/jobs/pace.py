"""How jobs go in time: what a job that succeeded leaves behind, and what later ones read off it.

How much of its work a job has done says little of its time: a search ends long before its budget is spent, an export
takes a minute without a word. A job that succeeds therefore keeps its *course*, pairs of its fraction and the share of
its whole time that had passed when it was reached. One that starts takes the median course of the last few of its kind
that were asked for the most alike, and where these were asked for just the same, how long they took. Where there are
none it goes by its fraction, and a job of jobs by what is left of those that run and by what the others are expected to
take.

All times are of the database's clock and without pauses, in which nobody worked on the job. ``JobRow.pace`` holds

* of both ``of``, the recordings that it goes back to;
* of a running job ``begun``, when it would have begun without its pauses; ``marks``, pairs of its fraction and the
  seconds in which it came there; ``course``, what it goes by; ``whole_s``, how long the same took before, or null;
  ``children``, seconds that jobs of these kinds take;
* of one that succeeded ``lasted_s`` and ``course``, its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.job import Progress
from physworld_storage.jobs.kind import share_of
from physworld_storage.jobs.kinds import KINDS, kind_of
from physworld_storage.jobs.progress import Course, longest_share, seconds_left, share_of_time
from physworld_storage.tables import DatasetRow, FitRow, JobRow, TraceRow

LOOKED_AT, TAKEN = 20, 5
"""Jobs of a kind among which the most alike are sought, and most that the median is of."""
PAUSE_S = 10.0
"""Without a word of any worker, after which nobody worked: who works tells so about every second."""
STEP = 0.01
"""Of the fraction, from one mark to the next."""
WEIGHT = 0.5
"""Of how long the same took before, in shares of a job's time: as much counts the pace so far when so much is over."""
NAMES = {"name", "model_name", "description", "tags", "dataset_id", "fit_id", "trace_id"}
NAMES |= {"motion_scale", "shift_x_m", "shift_y_m", "shift_z_m"}  # how far, not how long
"""Settings that say nothing of the time."""
ORIGINS: dict[str, type[FitRow | TraceRow | DatasetRow]] = {
    "fit": FitRow,
    "trace": TraceRow,
    "dataset": DatasetRow,
}
"""Tables of what jobs make of a scene, by the kind of their references."""


def begin(session: Session, job: JobRow, now: datetime) -> None:
    """Work on the job begins, or goes on after a pause.

    Args:
        session: the transaction of the claim.
        job: locked; its ``heartbeat_at`` is still that of the last word.
        now: by the database's clock.
    """
    if job.pace is None:
        of = _recordings(session, job)
        past = _past(session, job.kind, job.config, of)
        course = _median_course([example.course for example in past])
        job.pace = {
            "of": of,
            "begun": now.isoformat(),
            "marks": [],
            "course": course,
            "whole_s": median(example.lasted_s for example in past) if past and past[0].unlike == 0 else None,
            "children": {} if course else _children_s(session, job),
        }
    elif job.heartbeat_at is not None and now - job.heartbeat_at > timedelta(seconds=PAUSE_S):
        begun = datetime.fromisoformat(job.pace["begun"]) + (now - job.heartbeat_at)
        job.pace = {**job.pace, "begun": begun.isoformat()}


def mark(job: JobRow, now: datetime) -> None:
    """Remember when the job's fraction came where it is, once for every ``STEP``."""
    if job.pace is None:
        return
    fraction = Progress.model_validate(job.progress).fraction or 0.0
    marks = job.pace["marks"]
    last, since_s = marks[-1] if marks else (0.0, 0.0)
    if fraction >= last + STEP:
        at_s = max(since_s, round(worked_s(job, now), 2))
        job.pace = {**job.pace, "marks": [*marks, [fraction, at_s]]}


def end(job: JobRow, now: datetime) -> None:
    """The job has succeeded: what it leaves to later ones. One whose work was begun anew is no example."""
    lasted_s = 0.0 if job.pace is None else worked_s(job, now)
    if job.pace is None or job.attempt > 1 or lasted_s <= 0.0:
        job.pace = None
        return
    course = [[fraction, min(1.0, round(at_s / lasted_s, 4))] for fraction, at_s in job.pace["marks"]]
    job.pace = {"of": job.pace["of"], "lasted_s": round(lasted_s, 2), "course": course}


def worked_s(job: JobRow, now: datetime) -> float:
    """Seconds in which a job that has begun and not ended was worked on."""
    assert job.pace is not None
    return (now - datetime.fromisoformat(job.pace["begun"])).total_seconds()


def left_s(job: JobRow, children: Sequence[JobRow], now: datetime) -> float | None:
    """Seconds until the running job ends; None: too early to tell.

    Args:
        job: with its present progress.
        children: all of a job of jobs, in the order in which they were opened.
        now: by the database's clock.
    """
    if job.pace is None:  # it began before there was a pace
        return None
    fraction = Progress.model_validate(job.progress).fraction or 0.0
    course: Course = job.pace["course"]
    if kind_of(job).has_children and not course:
        return _left_of_children_s(job, children, now)
    worked, before_s = worked_s(job, now), job.pace["whole_s"]
    if not course:
        return seconds_left(worked, fraction)
    share = _share_of_time(job, fraction, now)
    if before_s is None:
        return seconds_left(worked, share)
    return float(round((worked + WEIGHT * before_s) / (share + WEIGHT) * (1.0 - share), 1))


def _share_of_time(job: JobRow, fraction: float, now: datetime) -> float:
    """Share of the job's time that is over by its course; it goes on where the fraction stands still."""
    assert job.pace is not None
    course, marks = job.pace["course"], job.pace["marks"]
    share = share_of_time(course, fraction)
    if not marks or marks[-1][1] <= 0.0:
        return share
    reached, at_s = marks[-1]
    since: float = share_of_time(course, reached) * worked_s(job, now) / at_s
    return max(share, min(since, longest_share(course, fraction)))


def share_done(parent: JobRow, children: Sequence[JobRow]) -> float:
    """How much of the work of a job of jobs is done, 0 to 1."""
    usual = [kind_of(child).seconds(child.config) for child in children]
    done = sum(seconds * share_of(child) for seconds, child in zip(usual, children, strict=True))
    to_come = sum(KINDS[kind].seconds(config) for kind, config in _to_come(parent, children))
    return float(min(1.0, done / (sum(usual) + to_come)))


def _to_come(parent: JobRow, children: Sequence[JobRow]) -> list[tuple[str, dict[str, Any]]]:
    """Kind and configuration of the children that have not been opened."""
    opened = Counter(child.kind for child in children)
    found = []
    for kind, config in kind_of(parent).chain(parent, children):
        opened[kind] -= 1
        if opened[kind] < 0:
            found.append((kind, config))
    return found


def _left_of_children_s(parent: JobRow, children: Sequence[JobRow], now: datetime) -> float | None:
    """What is left of the children that run, side by side, and of the others, one after another.

    Others take what such jobs took; where none is known, what they take on the sample scene, at the pace of the
    children that have ended, or of the first.
    """
    assert parent.pace is not None
    known: dict[str, float] = parent.pace["children"]
    ended = [child for child in children if child.state == "succeeded" and child.pace is not None]
    times = [(_whole_s(child, now), kind_of(child).seconds(child.config)) for child in ended or children]
    usual_s = sum(usual for whole, usual in times if whole is not None)
    took_s = sum(whole for whole, _ in times if whole is not None)

    def expected_s(kind: str, config: dict[str, Any]) -> float | None:
        return known.get(kind, took_s / usual_s * KINDS[kind].seconds(config) if usual_s else None)

    beside: list[float | None] = [0.0]
    others = [expected_s(kind, config) for kind, config in _to_come(parent, children)]
    for child in children:
        expected = expected_s(child.kind, child.config)
        if child.pace is None and child.state != "succeeded":  # it waits for a worker
            others.append(expected)
        elif child.state != "succeeded":
            whole = _whole_s(child, now) or expected
            beside.append(None if whole is None else max(0.0, whole - worked_s(child, now)))
    known_s = [left for left in (*beside, *others) if left is not None]
    if len(known_s) < len(beside) + len(others):
        return None
    return round(max(known_s[: len(beside)]) + sum(known_s[len(beside) :]), 1)


def _whole_s(child: JobRow, now: datetime) -> float | None:
    """How long a child took, or will have taken as it last told; None: not known."""
    if child.pace is None:
        return None
    if child.state == "succeeded":
        return float(child.pace["lasted_s"])
    left = Progress.model_validate(child.progress).eta_s
    return None if left is None else worked_s(child, now) + left


def _children_s(session: Session, parent: JobRow) -> dict[str, float]:
    """Seconds that the children to come take by kind, as jobs of their kinds took that were asked for the like."""
    found = {}
    for kind, config in kind_of(parent).chain(parent, ()) if kind_of(parent).has_children else ():
        usual, past = KINDS[kind].seconds, _past(session, kind, config)
        if past:
            found[kind] = median(example.lasted_s * usual(config) / usual(example.config) for example in past)
    return found


@dataclass(frozen=True)
class Example:
    """A job that succeeded: what it was asked for, in how much that is unlike what is asked now, and how it went."""

    config: dict[str, Any]
    unlike: int
    lasted_s: float
    course: Course


def _past(session: Session, kind: str, config: dict[str, Any], of: list[str] | None = None) -> list[Example]:
    """The last jobs of a kind that differ in the fewest settings and recordings, the newest first.

    Args:
        session: the transaction that reads.
        kind: of the jobs.
        config: what is asked now.
        of: the recordings that it goes back to; None: not known yet.
    """
    succeeded = (JobRow.kind == kind, JobRow.state == "succeeded", JobRow.pace.is_not(None))
    columns = select(JobRow.config, JobRow.pace).where(*succeeded)
    decisive = KINDS[kind].decisive
    found = [
        Example(
            config=before,
            unlike=_unlike(config, before) + (of is not None and of != pace["of"]),
            lasted_s=pace["lasted_s"],
            course=pace["course"],
        )
        for before, pace in session.execute(columns.order_by(JobRow.created_at.desc()).limit(LOOKED_AT))
        if pace is not None and all(before.get(name) == config.get(name) for name in decisive)
    ]
    fewest = min((example.unlike for example in found), default=0)
    return [example for example in found if example.unlike == fewest][:TAKEN]


def _recordings(session: Session, job: JobRow) -> list[str]:
    """Ids of the scenes that the job's inputs go back to, and of inputs that go back to none."""
    found = set()
    for item in job.inputs:
        table = ORIGINS.get(item["kind"])
        row = None if table is None else session.get(table, item["id"])
        found.add(str(getattr(row, "scene_id", item["id"])))
    return sorted(found)


def _unlike(one: dict[str, Any], other: dict[str, Any]) -> int:
    """In how many settings two configurations differ that say something of the time."""
    count = 0
    for name in (one.keys() | other.keys()) - NAMES:
        mine, yours = one.get(name), other.get(name)
        if isinstance(mine, dict) and isinstance(yours, dict):
            count += _unlike(mine, yours)
        else:
            count += mine != yours
    return count


def _median_course(courses: Sequence[Course]) -> Course:
    """The median of courses, at the fractions of the first."""
    return [
        [fraction, median(share_of_time(course, fraction) for course in courses)]
        for fraction, _ in (courses[0] if courses else ())
    ]
