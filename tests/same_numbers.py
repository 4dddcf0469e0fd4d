"""Runs that are to be the same: bit for bit on a CPU, up to the order of sums on a GPU."""

from __future__ import annotations

import numpy as np

from physworld.devices import default_device

ROUNDING_M = 1e-6  # solids strain in single precision


def assert_same(found: np.ndarray, expected: np.ndarray) -> None:
    """Places [m] of two runs that differ in nothing that counts."""
    if default_device() == "cpu":
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=ROUNDING_M)
