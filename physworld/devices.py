"""The device that simulations take where nobody names one."""

from __future__ import annotations

import os

DEVICE_VARIABLE = "PHYSWORLD_DEVICE"


def default_device() -> str:
    """``PHYSWORLD_DEVICE``, the variable that the service reads too, or "cpu"."""
    return os.environ.get(DEVICE_VARIABLE) or "cpu"
