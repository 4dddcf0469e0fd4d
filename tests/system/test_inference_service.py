"""The real embedded service predicts and plans: inference process, planner worker and API as a person starts them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from physworld_client import Client
from published_tiny import publish_tiny, tiny_model
from service_process import ServiceProcess, until

from physworld_schemas.plan import PlanConfig

SINGLE_PRECISION_M = 2e-6


@pytest.mark.slow
def test_rollouts_and_plans_of_the_service_survive_a_killed_inference_process(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "0", "--no-trainer") as service:
        service.start()
        database, stores = service.stores()
        name, _ = publish_tiny(database, stores.artifacts)
        model = tiny_model()[2]
        path = np.repeat(model.start_controllers[-1:], 12, axis=0)
        path[:3] = model.start_controllers
        expected = model.skin.apply(model.rollout(path.astype(np.float32).astype(float)))
        state = service.state()
        with Client(
            state["api_url"], Path(state["api_key_file"]).read_text().strip(), timeout=90.0
        ) as client:
            at_once = client.rollouts.create(name, path)
            assert at_once.rollout.id is None
            assert at_once.points[0] == pytest.approx(expected, abs=SINGLE_PRECISION_M)

            before = service.kill_child("inference")
            queued = client.rollouts.create(name, path, as_job=True, timeout=120.0)
            assert queued.points[0] == pytest.approx(expected, abs=SINGLE_PRECISION_M)
            until(
                lambda: service.state()["children"].get("inference", before) != before,
                "the inference process was not started again",
                30.0,
            )
            assert client.rollouts.create(name, path).points == pytest.approx(at_once.points)

            job = client.plans.create(
                name,
                points={3: [0.12, 0.02, 0.01]},
                config=PlanConfig(horizon=12, samples=16, iterations=2),
            )
            client.jobs.wait(job, 180.0)
            plan = client.plans.get(job.outputs[0].id)
            assert plan.executed_error_m < plan.motionless_error_m
        database.dispose()
