"""Which device is taken where nobody names one, and where torch follows."""

from __future__ import annotations

import pytest
import torch

from physworld.calibrate import CalibrationConfig
from physworld.devices import default_device, torch_device
from physworld.engine.problem import Problem
from physworld.video.splat_fit import SplatConfig


def test_the_variable_is_the_default_and_an_empty_one_is_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in (("cuda:0", "cuda:0"), ("", "cpu"), ("cpu", "cpu")):
        monkeypatch.setenv("PHYSWORLD_DEVICE", value)
        assert default_device() == expected
    monkeypatch.delenv("PHYSWORLD_DEVICE")
    assert default_device() == "cpu"


def test_problems_calibrations_and_splats_take_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHYSWORLD_DEVICE", "cuda:7")
    assert Problem(None, None, None, None).device == "cuda:7"  # type: ignore[arg-type]
    assert CalibrationConfig().device == SplatConfig().device == "cuda:7"


@pytest.mark.parametrize("knows", [True, False])
def test_torch_stays_on_the_cpu_where_its_build_knows_no_gpu(
    knows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: knows)
    assert torch_device("cuda:0") == ("cuda:0" if knows else "cpu")
    assert torch_device("cpu") == "cpu"
