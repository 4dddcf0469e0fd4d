"""The table of the world model's speeds: what a person reads is named, every case of it."""

from __future__ import annotations

from types import ModuleType

import pytest

from benchmarks.harness import Timing

PEERS = {"pyg", "train naive", "batch torch"}
# PyTorch Geometric scripts some of its own classes when it is imported.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


@pytest.fixture
def world_model() -> ModuleType:
    pytest.importorskip(
        "torch_geometric", reason="PyTorch Geometric, the peer of this benchmark, is not installed"
    )
    from benchmarks.speed import world_model

    return world_model


def test_every_case_that_is_measured_has_a_row_of_its_own_name(world_model: ModuleType) -> None:
    cases, spec = world_model.cases_of(hidden=16, seed=0)
    assert set(cases) | {"twin", "spring_mass"} == set(world_model.LABELS)
    assert len(set(world_model.LABELS.values())) == len(world_model.LABELS)
    timings = {name: Timing(2.0 if name in PEERS else 4.0, 0.1, (2.0,)) for name in cases}
    rows = {row[1]: row[2:] for row in (world_model._row("16", *item, timings) for item in timings.items())}
    assert rows["rollout: ours, near edges of the current shape"] == ["4 ± 0.1 steps/s", "2.00"]
    assert rows["training: ours, near edges of the current shape"] == ["4 ± 0.1 ms a sample", "0.50"]
    assert rows["batch: ours, all cores"] == ["4 ± 0.1 rollouts/s", "2.00"]
    assert spec.current_neighbours == 0
