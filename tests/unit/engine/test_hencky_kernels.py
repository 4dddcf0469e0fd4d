"""Trial deformations and their principal stretches against numpy, where eigenvalues meet and where they lie apart."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from physworld.devices import default_device
from physworld.engine.updated.hencky_kernels import eigen_type, stretch

EXACT = 1e-12
"""Share of the largest entry: Jacobi's rotations end at an off-diagonal of 1e-11 of the trace, whose square counts."""


def turned(stretches: tuple[float, float, float], seed: int) -> np.ndarray:
    left, right = (np.linalg.qr(np.random.default_rng(seed + k).normal(size=(3, 3)))[0] for k in (0, 1))
    return left @ np.diag(stretches) @ right


CASES = {
    "undeformed": np.eye(3),
    "sheared": np.array([[1.0, 0.7, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "two equal": turned((1.2, 1.2, 0.7), 1),
    "nearly equal": turned((1.0 + 1e-9, 1.0, 1.0 - 1e-9), 2),
    "far apart": turned((30.0, 1.0, 0.02), 3),
    "any": turned((1.4, 1.1, 0.8), 4),
}


@pytest.mark.parametrize("beside", sorted(CASES))
def test_principal_stretches_are_those_of_numpy(beside: str) -> None:
    """All cases in one group of lanes, so that a slow one turns the others further without harm."""
    F = np.array([CASES[beside], *CASES.values(), np.eye(3)])
    C = np.random.default_rng(5).normal(scale=10.0, size=F.shape).astype(np.float32)
    dt = 1e-3
    clock = wp.array([0.1, 1.0 / dt, dt], dtype=wp.float64, device=default_device())
    state = wp.array(F.reshape(-1), dtype=wp.float64, device=default_device())
    eigen = wp.zeros(8, dtype=eigen_type, device=default_device())
    velocity = wp.array(C.reshape(-1), dtype=wp.float32, device=default_device())
    wp.launch(stretch, 1, inputs=[clock, velocity, state], outputs=[eigen], device=default_device())
    trial = F + dt * C.astype(float) @ F
    assert np.abs(state.numpy().reshape(-1, 3, 3) - trial).max() < 1e-14 * np.abs(trial).max()
    vectors, values = eigen.numpy()[:, :3], eigen.numpy()[:, 3]
    B = trial @ trial.transpose(0, 2, 1)
    again = np.einsum("pk,pki,pkj->pij", values, vectors, vectors)
    sizes = np.abs(B).max(axis=(1, 2))
    assert (np.abs(again - B).max(axis=(1, 2)) < 10 * EXACT * sizes).all()
    assert np.abs(vectors @ vectors.transpose(0, 2, 1) - np.eye(3)).max() < EXACT
    expected = np.linalg.eigvalsh(B)
    assert (np.abs(np.sort(values, axis=1) - expected).max(axis=1) < EXACT * sizes).all()
