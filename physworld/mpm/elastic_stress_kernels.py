"""Device side of elastic materials in the updated Lagrangian form: Kirchhoff stress from F, one particle a thread.

    tau = mu (F F^T - I) + lambda ln(J) I + 2 eta d J        compressible neo-Hookean with Kelvin-Voigt friction

the same solid as :mod:`physworld.mpm.solid_kernels` (tau = P F^T). F is read in double precision and F F^T - I is
formed from F - I, so small strains keep their digits. ln J is taken from J - 1, with the rounding of 1 + (J - 1)
put back.

Legend: F deformation gradient, H = F - I, J = det F, d symmetric part of the velocity gradient C.
"""

from __future__ import annotations

import warp as wp

_NEO_HOOKEAN = r"""
    const double* f = &F.data[9 * p];
    float H[9];
    for (int k = 0; k < 9; ++k) H[k] = (float)(f[k] - (k % 4 == 0 ? 1.0 : 0.0));
    // J - 1 = tr H + (sum of principal minors of H) + det H
    const float minors = H[0] * H[4] - H[1] * H[3] + H[0] * H[8] - H[2] * H[6] + H[4] * H[8] - H[5] * H[7];
    const float determinant = H[0] * (H[4] * H[8] - H[5] * H[7]) - H[1] * (H[3] * H[8] - H[5] * H[6])
                            + H[2] * (H[3] * H[7] - H[4] * H[6]);
    const float grown = H[0] + H[4] + H[8] + minors + determinant;
    const float J = 1.0f + grown;
    if (!(J > 0.02f)) { flags.data[3] = 1; return; }
    const float m = mu.data[p] * volume.data[p];
    const float pressure = lam.data[p] * volume.data[p] * (logf(J) - ((J - 1.0f) - grown) / J);   // ln(1 + grown)
    const float* c = &C.data[9 * p];
    const float e = eta.data[p] * J;
    const int row[6] = {0, 1, 2, 1, 0, 0}, column[6] = {0, 1, 2, 2, 2, 1};
    for (int k = 0; k < 6; ++k) {
        const int i = row[k], j = column[k];
        const float b = H[3 * i + j] + H[3 * j + i] + H[3 * i] * H[3 * j] + H[3 * i + 1] * H[3 * j + 1]
                      + H[3 * i + 2] * H[3 * j + 2];
        stress.data[6 * p + k] = m * b + (i == j ? pressure : 0.0f) + e * (c[3 * i + j] + c[3 * j + i]);
    }
"""


@wp.func_native(_NEO_HOOKEAN)
def _neo_hookean(
    p: int,
    mu: wp.array(dtype=wp.float32),
    lam: wp.array(dtype=wp.float32),
    volume: wp.array(dtype=wp.float32),
    eta: wp.array(dtype=wp.float32),
    C: wp.array(dtype=wp.float32),
    F: wp.array(dtype=wp.float64),
    stress: wp.array(dtype=wp.float32),
    flags: wp.array(dtype=wp.int32),
): ...


@wp.kernel(enable_backward=False)
def neo_hookean_stress(
    # model
    mu: wp.array(dtype=wp.float32),
    lam: wp.array(dtype=wp.float32),
    volume: wp.array(dtype=wp.float32),
    eta: wp.array(dtype=wp.float32),
    # in
    C: wp.array(dtype=wp.float32),
    F: wp.array(dtype=wp.float64),
    # out
    stress: wp.array(dtype=wp.float32),
    flags: wp.array(dtype=wp.int32),
):
    """Volume times Kirchhoff stress [J] of one particle, (6P,): xx yy zz yz xz xy; ``eta``: volume times viscosity."""
    _neo_hookean(wp.tid(), mu, lam, volume, eta, C, F, stress, flags)
