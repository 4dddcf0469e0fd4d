# Made of async_predict.py by `make sdk`: change that file.
"""Using published models: rollouts and plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from physworld_client import predictions
from physworld_client.base import Listed
from physworld_client.calls import Call, route
from physworld_client.pages import ListPage
from physworld_client.predictions import Planned, Predicted
from physworld_client.resources import LATEST
from physworld_client.types import Array, Job, Plan, Rollout
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.plan import PlanConfig, PlanCreate, PlanLimits
from physworld_schemas.rollout import Part, Predictor, RolloutCreate, Start

ANSWER_S = 60.0
"""Seconds that the service may work on a rollout before it answers."""


class Rollouts(Listed):
    """What published models predict."""

    resource = "rollouts"

    def create(
        self,
        model: str,
        controllers: Array,
        version: int | str = LATEST,
        *,
        times: Array | None = None,
        dt_s: float | None = None,
        start: Start = "recording",
        phi: Array | None = None,
        stiffness_factor: float = 1.0,
        density_factor: float = 1.0,
        returns: Sequence[Part] = ("points",),
        every: int = 1,
        open_s: Sequence[Sequence[tuple[float, float]]] | None = None,
        by: Predictor | None = None,
        as_job: bool = False,
        timeout: float | None = None,
    ) -> Predicted:
        """Predicts control paths and returns the arrays; a large batch is a job, which is waited for.

        Args:
            controllers: all control points [m], (B, T, K, 3) or (T, K, 3); with ``start`` "recording" the first
                h + 1 ticks belong to the model's history.
            times: of the T places [s], from 0, where they are not at ticks of the model's clock.
            dt_s: the time step that the paths were made for; the service refuses another than the model's.
            start: "recording", or "rest": the body lies still where the recording begins.
            phi: log property ratios, (n, 2) or (B, n, 2); by default the fine-tuned ones.
            stiffness_factor, density_factor: on top of them.
            returns: "points" (measured points), "vertices" (the graph's).
            every: return each so many-th tick.
            open_s: of each grip of the scene, times at which it is open, (begin, end) [s] from 0; by default all hold.
            by: "model": the network, or "twin": the calibrated twin that the version learned from, always as a job and
                without ``phi``; by default the ``predictor`` of the version's metrics.
            as_job: queue it, however small.
            timeout: seconds to wait for a job.
        """
        body = RolloutCreate(
            model=model,
            version=version,
            controllers=EncodedArray.of(np.asarray(controllers)),
            start=start,
            stiffness_factor=stiffness_factor,
            density_factor=density_factor,
            returns=list(returns),
            every=every,
            open_s=None if open_s is None else [list(spans) for spans in open_s],
            by=by,
            mode="job" if as_job else "auto",
            times=None if times is None else np.asarray(times, dtype=np.float64).tolist(),
            dt_s=dt_s,
            phi=None if phi is None else EncodedArray.of(np.asarray(phi)),
        )
        either = cast("type[Rollout | Job]", Rollout | Job)
        call = Call("POST", route("rollouts"), either, body=body, read_timeout_s=ANSWER_S)
        answer = self._client.send(call)
        if isinstance(answer, Rollout):
            return predictions.predicted(answer)
        job = self._client.jobs.wait(answer, timeout)
        return self.result(job.outputs[0].id)

    def get(self, rollout_id: str) -> Rollout:
        """A rollout that was a job."""
        return self._send("GET", Rollout, "rollouts", self.id_of(rollout_id))

    def result(self, rollout_id: str) -> Predicted:
        """The arrays of a rollout that was a job."""
        rollout = self.get(rollout_id)
        artifact, call = predictions.file_of(rollout.artifacts, "rollout.npz", rollout_id)
        return predictions.predicted(rollout, predictions.checked_arrays(artifact, self._client.send(call)))

    def list(
        self, *, limit: int | None = None, cursor: str | None = None, model: str | None = None
    ) -> ListPage[Rollout]:
        """Rollouts that were jobs, newest first."""
        return self._page(Rollout, "rollouts", cursor=cursor, limit=limit, model=model)


class Plans(Listed):
    """Motions of the grips that bring the object to a goal."""

    resource = "plans"

    def create(
        self,
        model: str,
        version: int | str = LATEST,
        *,
        points: dict[int, Sequence[float]] | None = None,
        shape: Array | None = None,
        limits: PlanLimits | None = None,
        config: PlanConfig | None = None,
    ) -> Job:
        """Starts a plan; its job's output is the plan.

        Args:
            points: places [m] for measured points, by their number.
            shape: or a cloud of points [m], (M, 3), for the whole body.
            limits: of speed, acceleration, workspace; by default the recording's.
            config: horizon, samples, iterations, seed.
        """
        body = PlanCreate(
            model=model,
            version=version,
            goal=predictions.goal_of(points, shape),
            limits=limits or PlanLimits(),
            config=config or PlanConfig(),
        )
        return self._send("POST", Job, "plans", body=body)

    def get(self, plan_id: str) -> Plan:
        """One plan: errors of the prediction and of its execution in the twin."""
        return self._send("GET", Plan, "plans", self.id_of(plan_id))

    def result(self, plan_id: str) -> Planned:
        """A plan with its arrays: control path, predicted and executed paths."""
        plan = self.get(plan_id)
        artifact, call = predictions.file_of(plan.artifacts, "plan.npz", plan_id)
        return Planned(plan, predictions.checked_arrays(artifact, self._client.send(call)))

    def list(
        self, *, limit: int | None = None, cursor: str | None = None, model: str | None = None
    ) -> ListPage[Plan]:
        """Plans, newest first."""
        return self._page(Plan, "plans", cursor=cursor, limit=limit, model=model)
