"""Device side of what acts on particles of updated Lagrangian MPM directly: forces beside the law's.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]).
"""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def widen(v: wp.array[wp.float32], velocity: wp.array[wp.float64]) -> None:
    """One component of the particles' velocities [m/s] in double precision, as forces read it."""
    k = wp.tid()
    velocity[k] = wp.float64(v[k])


@wp.kernel(enable_backward=False)
def kick(
    # model
    mass: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    # in, cleared
    force: wp.array[wp.float64],
    # in, out
    v: wp.array[wp.float32],
) -> None:
    """One component of the velocity [m/s] after the force [N] of a substep."""
    k = wp.tid()
    v[k] = wp.float32(wp.float64(v[k]) + clock[2] * force[k] / mass[k // 3])
    force[k] = wp.float64(0.0)
