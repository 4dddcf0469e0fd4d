"""Descents and places of searches with the same controls, whose simulations go to the runner together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from physworld.arrays import Array
from physworld.calibrate.optimum import Descended, Descent, Optimum, Place
from physworld.estimation.simulations import idle_beside

if TYPE_CHECKING:
    from physworld.calibrate.search import Search


def measured_together(asked: list[tuple[Search, Place]]) -> Iterator[tuple[Array, float | None]]:
    """Residuals and their root mean squares [m] of places of searches with one drive."""
    jobs = [search.job(place) for search, place in asked]
    made = asked[0][0].run(jobs) if asked else iter(())
    for (search, _), job, tracks in zip(asked, jobs, made, strict=True):
        yield search.compared(job, tracks)


def in_step(several: list[tuple[Search, Descent]]) -> list[Descended]:
    """Descents in step with each other: what all of them ask for next is run together.

    Processes that would wait meanwhile run what the descents will likely ask for after that. Such a run counts only
    once it is asked for.
    """
    asking = [search.begun(one) for search, one in several]
    asked = {k: next(one) for k, one in enumerate(asking)}
    runs, losses = [0] * len(several), [[] for _ in several]  # type: ignore[var-annotated]
    found: dict[int, Optimum] = {}
    known: dict[tuple[int, bytes], tuple[Array, float | None]] = {}
    while asked:
        needed = [(k, theta) for k, (places, _) in asked.items() for theta in places]
        missing = [(k, theta) for k, theta in needed if (k, theta.tobytes()) not in known]
        ahead = [
            (k, theta)
            for k, (_, likely) in asked.items()
            for theta in likely
            if (k, theta.tobytes()) not in known
        ]
        run = missing + ahead[: idle_beside(several[0][0].runner, len(missing))]
        places = [(several[k][0], (several[k][1].parameters, theta, several[k][1].end)) for k, theta in run]
        arriving = zip([(k, theta.tobytes()) for k, theta in run], measured_together(places), strict=True)
        for k in list(asked):
            search, one = several[k]
            residuals = []
            for theta in asked[k][0]:
                while (k, theta.tobytes()) not in known:
                    arrived, result = next(arriving)
                    known[arrived] = result
                residual, loss = known.pop((k, theta.tobytes()))
                runs[k] += 1
                if loss is not None:
                    if one.end in (None, search.end):
                        losses[k].append(loss)
                    search.tell(search.simulations + sum(runs), loss, (one.parameters, theta, None))
                residuals.append(residual)
            try:
                asked[k] = asking[k].send(residuals)
            except StopIteration as ended:
                found[k] = Optimum(ended.value.theta, ended.value.cost)
                del asked[k]
        known.update(arriving)
    return [Descended(found[k], runs[k], losses[k]) for k in range(len(several))]
