"""What a job tells of its progress: of the whole of it, never less than before, with the time left."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from physworld_schemas.job import Progress
from physworld_storage.jobs import leases
from physworld_storage.jobs.progress import of_the_job, seconds_left

if TYPE_CHECKING:
    from conftest import Work

LEASE_SECONDS = 30.0


def test_the_time_left_is_the_time_so_far_for_what_is_left() -> None:
    assert seconds_left(30.0, 0.75) == pytest.approx(10.0)
    assert seconds_left(30.0, 1.0) == 0.0
    assert seconds_left(1.0, 0.75) is None and seconds_left(30.0, 0.001) is None


def test_a_shards_share_is_put_into_the_part_of_the_job_that_it_covers() -> None:
    told = of_the_job(Progress(done=5, total=10), Progress(), (0.95, 1.0))
    assert told.fraction == pytest.approx(0.975)
    assert (told.done, told.total) == (5, 10)


def test_the_share_never_falls_when_the_work_begins_anew(work: Work) -> None:
    job = work.fit()
    lease = work.claim()
    shares = []
    for done in (12, 40, 3, 41):  # 3: a new attempt, or a stage that counts something else
        with work.database.session() as session:
            leases.renew(session, lease, LEASE_SECONDS, Progress(done=done, total=80, unit="simulations"))
        shares.append(work.job(job).progress.fraction)
    assert shares == [0.15, 0.5, 0.5, 0.5125]


def test_a_dataset_is_not_done_before_it_is_sealed(work: Work) -> None:
    job = work.dataset(episodes=4)
    assert work.complete(work.claim())
    shares = [work.job(job).progress.fraction]
    for _ in range(4):
        assert work.complete(work.claim())
        shares.append(work.job(job).progress.fraction)
    assert shares == sorted(shares) and shares[0] <= 0.1 and 0.9 < shares[-1] < 1.0
    assert work.complete(work.claim())
    done = work.job(job)
    assert (done.state, done.share, done.progress.fraction, done.progress.eta_s) == (
        "succeeded",
        1.0,
        1.0,
        None,
    )
