"""The device that simulations take where nobody names one, and the one on which torch can follow them."""

from __future__ import annotations

import os

DEVICE_VARIABLE = "PHYSWORLD_DEVICE"


def default_device() -> str:
    """``PHYSWORLD_DEVICE``, the variable that the service reads too, or "cpu"."""
    return os.environ.get(DEVICE_VARIABLE) or "cpu"


def torch_device(simulations: str) -> str:
    """Where torch computes beside simulations on a device: there, or on the CPU where its build knows no GPU.

    The build that the project installs is the CPU's; Warp brings CUDA by itself.

    Args:
        simulations: Warp's name of their device, "cpu" or "cuda:0".
    """
    import torch

    return simulations if simulations == "cpu" or torch.cuda.is_available() else "cpu"
