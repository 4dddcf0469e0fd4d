"""Device side of the transfers of updated Lagrangian MPM: particles to grid and back, quadratic B-splines.

    p2g   m_i += w m      p_i += w (m v + (m C - dt V tau D^-1)(x_i - x))          MLS-MPM, Hu et al. 2018
    g2p   v = sum w v_i   C = sum w v_i (x_i - x)^T D^-1    D = dx^2 / 4           APIC, Jiang et al. 2015

The grid is a flat box of nodes (momentum, mass), four floats each, z fastest. The three nodes of a row are twelve
neighbouring floats: on a CPU one 512-bit register takes a row, a fourth node's lanes multiply by zero, and a transfer
is nine rows. On CUDA one thread loops over the 27 nodes and adds atomically. Cell c spans [c, c + 1] dx from the grid's
origin, its node sits in the middle (:mod:`physworld.mpm.bspline`).

Positions and deformation gradients are double precision (small increments of a slow motion would be rounded away),
velocities and the grid single.

Legend: t local coordinate in the cell, w weights, d distances to the three nodes, Q affine momentum, box = first cell
(3) and nodes (3) of the box an axis and the width of its rim; flags: see ``RIM`` to ``INVERTED``.
"""

from __future__ import annotations

import warp as wp

RIM, ESCAPED, NOT_FINITE, INVERTED = (
    0,
    1,
    2,
    3,
)  # places in ``flags``; ``extremes[0]``: cells crossed in a substep

_LOCATE = r"""
    const int n0 = box.data[3], n1 = box.data[4], n2 = box.data[5], rim = box.data[6];
    int b[3];
    float w[3][3], d[3][3];
    bool inside = true, near = false;
    for (int j = 0; j < 3; ++j) {
        const double s = (x.data[3 * p + j] - origin[j]) * (double)inv_dx[j];
        if (!(s > -1.0e9 && s < 1.0e9)) { flags.data[2] = 1; return; }
        const double cell = floor(s);
        const float t = (float)(s - cell);
        b[j] = (int)cell - 1 - box.data[j];
        w[j][0] = 0.5f * (1.0f - t) * (1.0f - t);
        w[j][1] = 0.5f + t - t * t;
        w[j][2] = 0.5f * t * t;
        for (int a = 0; a < 3; ++a) d[j][a] = ((float)a - 0.5f - t) * dx[j];
        inside = inside && b[j] >= 0 && b[j] + 2 < box.data[3 + j];
        near = near || b[j] < rim || b[j] + 2 >= box.data[3 + j] - rim;
    }
    if (!inside) { flags.data[1] = 1; return; }
"""

_ROW = r"""
#if !defined(__CUDA_ARCH__)
    typedef float W __attribute__((vector_size(64), aligned(4)));
    typedef float Q4 __attribute__((vector_size(16), aligned(4)));
    auto repeat = [](Q4 q) -> W {
        return __builtin_shufflevector(q, q, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
    };
    auto lanes = [](float a, float b, float c) -> W {
        return W{a, a, a, a, b, b, b, b, c, c, c, c, 0.0f, 0.0f, 0.0f, 0.0f};
    };
#endif
"""

_SCATTER = (
    _ROW
    + _LOCATE
    + r"""
    if (near) flags.data[0] = 1;
    const float m = mass.data[p];
    const float dt = (float)clock.data[2];
    float Q[9], S[9];
    const float* T = &stress.data[6 * p];   // xx yy zz yz xz xy
    const int voigt[9] = {0, 5, 4, 5, 1, 3, 4, 3, 2};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            S[3 * i + j] = -4.0f * dt * inv_dx[j] * inv_dx[j] * T[voigt[3 * i + j]];
            Q[3 * i + j] = m * C.data[9 * p + 3 * i + j] + (split ? 0.0f : S[3 * i + j]);
        }
    const float mv[3] = {m * v.data[3 * p], m * v.data[3 * p + 1], m * v.data[3 * p + 2]};
    float* grid = (float*)momentum.data;
    float* push = (float*)impulse.data;
#if defined(__CUDA_ARCH__)
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                const float weight = w[0][i] * w[1][j] * w[2][k];
                const int at = 4 * (((b[0] + i) * n1 + b[1] + j) * n2 + b[2] + k);
                for (int a = 0; a < 3; ++a) {
                    const float* row = &Q[3 * a];
                    atomicAdd(&grid[at + a], weight * (mv[a] + row[0] * d[0][i] + row[1] * d[1][j] + row[2] * d[2][k]));
                    if (split) {
                        const float* kick = &S[3 * a];
                        atomicAdd(&push[at + a], weight * (kick[0] * d[0][i] + kick[1] * d[1][j] + kick[2] * d[2][k]));
                    }
                }
                atomicAdd(&grid[at + 3], weight * m);
            }
#else
    const W wz = lanes(w[2][0], w[2][1], w[2][2]);
    const W dz = lanes(d[2][0], d[2][1], d[2][2]);
    auto spread = [&](const float* A, const float* base, float weight, float* target) {
        const W ax = wz * repeat(Q4{A[0], A[3], A[6], 0.0f}), ay = wz * repeat(Q4{A[1], A[4], A[7], 0.0f});
        const W az = wz * repeat(Q4{A[2], A[5], A[8], 0.0f});
        const W first = wz * repeat(Q4{base[0], base[1], base[2], weight}) + az * dz;
        for (int i = 0; i < 3; ++i) {
            const W plane = (first + ax * d[0][i]) * w[0][i];
            const W tilt = ay * w[0][i];
            float* at = target + 4 * (((b[0] + i) * n1 + b[1]) * n2 + b[2]);
            for (int j = 0; j < 3; ++j) {
                W* row = (W*)(at + 4 * j * n2);
                *row = *row + (plane + tilt * d[1][j]) * w[1][j];
            }
        }
    };
    spread(Q, mv, m, grid);
    if (split) {
        const float none[3] = {0.0f, 0.0f, 0.0f};
        spread(S, none, 0.0f, push);
    }
#endif
"""
)

_GATHER = (
    _ROW
    + _LOCATE
    + r"""
    const double dt = clock.data[2];
    float nv[3] = {0.0f, 0.0f, 0.0f}, ov[3] = {0.0f, 0.0f, 0.0f}, A[9];
    for (int k = 0; k < 9; ++k) A[k] = 0.0f;
    const float* grid = (const float*)velocity.data;
    const float* old = (const float*)velocity_old.data;
#if defined(__CUDA_ARCH__)
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                const float weight = w[0][i] * w[1][j] * w[2][k];
                const int at = 4 * (((b[0] + i) * n1 + b[1] + j) * n2 + b[2] + k);
                for (int a = 0; a < 3; ++a) {
                    const float u = weight * grid[at + a];
                    nv[a] += u;
                    A[3 * a] += u * d[0][i];
                    A[3 * a + 1] += u * d[1][j];
                    A[3 * a + 2] += u * d[2][k];
                    if (split) ov[a] += weight * old[at + a];
                }
            }
#else
    const W wz = lanes(w[2][0], w[2][1], w[2][2]);
    const W wdz = wz * lanes(d[2][0], d[2][1], d[2][2]);
    W sum = W{}, sumx = W{}, sumy = W{}, sumold = W{};
    for (int i = 0; i < 3; ++i) {
        const int at = 4 * (((b[0] + i) * n1 + b[1]) * n2 + b[2]);
        W plane = W{}, tilt = W{}, before = W{};
        for (int j = 0; j < 3; ++j) {
            const W row = *(const W*)(grid + at + 4 * j * n2) * w[1][j];
            plane += row;
            tilt += row * d[1][j];
            if (split) before += *(const W*)(old + at + 4 * j * n2) * w[1][j];
        }
        plane *= w[0][i];
        sum += plane;
        sumx += plane * d[0][i];
        sumy += tilt * w[0][i];
        if (split) sumold += before * w[0][i];
    }
    auto fold = [](W r) -> Q4 {
        return __builtin_shufflevector(r, r, 0, 1, 2, 3) + __builtin_shufflevector(r, r, 4, 5, 6, 7)
             + __builtin_shufflevector(r, r, 8, 9, 10, 11);
    };
    const Q4 f = fold(sum * wz), fx = fold(sumx * wz), fy = fold(sumy * wz), fz = fold(sum * wdz);
    for (int a = 0; a < 3; ++a) {
        nv[a] = f[a];
        A[3 * a] = fx[a];
        A[3 * a + 1] = fy[a];
        A[3 * a + 2] = fz[a];
    }
    if (split) {
        const Q4 fo = fold(sumold * wz);
        for (int a = 0; a < 3; ++a) ov[a] = fo[a];
    }
#endif
    for (int a = 0; a < 3; ++a)
        for (int j = 0; j < 3; ++j) A[3 * a + j] *= 4.0f * inv_dx[j] * inv_dx[j];
    for (int k = 0; k < 9; ++k) C.data[9 * p + k] = A[k];
    double* G = &F.data[9 * p];
    double N[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            N[3 * i + j] = G[3 * i + j] + dt * ((double)A[3 * i] * G[j] + (double)A[3 * i + 1] * G[3 + j]
                                                + (double)A[3 * i + 2] * G[6 + j]);
    float keep = 0.0f, shift = 0.0f;
    if (split) {
        keep = adjustment;
        const double J = N[0] * (N[4] * N[8] - N[5] * N[7]) - N[1] * (N[3] * N[8] - N[5] * N[6])
                       + N[2] * (N[3] * N[7] - N[4] * N[6]);
        shift = J > separating && x.data[3 * p + 2] > clear ? adjustment : 0.0f;
    }
    for (int k = 0; k < 9; ++k) G[k] = N[k];
    float most = 0.0f;
    for (int j = 0; j < 3; ++j) {
        const float difference = split ? v.data[3 * p + j] - ov[j] : 0.0f;
        const double step = dt * ((double)nv[j] + (double)(shift * difference));
        v.data[3 * p + j] = nv[j] + keep * difference;
        x.data[3 * p + j] += step;
        const float crossed = fabsf((float)step * inv_dx[j]);
        if (!(crossed < 1.0e9f)) flags.data[2] = 1;
        most = crossed > most ? crossed : most;
    }
#if defined(__CUDA_ARCH__)
    atomicMax((int*)&extremes.data[0], __float_as_int(most));   // non-negative floats order like their bits
#else
    if (most > extremes.data[0]) extremes.data[0] = most;
#endif
"""
)


@wp.func_native(_SCATTER)
def _scatter(
    p: int,
    # model
    mass: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    clock: wp.array(dtype=wp.float64),
    box: wp.array(dtype=wp.int32),
    # in
    x: wp.array(dtype=wp.float64),
    v: wp.array(dtype=wp.float32),
    C: wp.array(dtype=wp.float32),
    stress: wp.array(dtype=wp.float32),
    # out
    momentum: wp.array(dtype=wp.vec4f),
    impulse: wp.array(dtype=wp.vec4f),
    flags: wp.array(dtype=wp.int32),
): ...


@wp.func_native(_GATHER)
def _gather(
    p: int,
    # model
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    adjustment: float,
    separating: wp.float64,
    clear: wp.float64,
    clock: wp.array(dtype=wp.float64),
    box: wp.array(dtype=wp.int32),
    # in
    velocity: wp.array(dtype=wp.vec4f),
    velocity_old: wp.array(dtype=wp.vec4f),
    # in, out
    x: wp.array(dtype=wp.float64),
    v: wp.array(dtype=wp.float32),
    C: wp.array(dtype=wp.float32),
    F: wp.array(dtype=wp.float64),
    # out
    flags: wp.array(dtype=wp.int32),
    extremes: wp.array(dtype=wp.float32),
): ...


@wp.kernel(enable_backward=False)
def particles_to_grid(
    # model
    mass: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    clock: wp.array(dtype=wp.float64),
    box: wp.array(dtype=wp.int32),
    # in
    x: wp.array(dtype=wp.float64),
    v: wp.array(dtype=wp.float32),
    C: wp.array(dtype=wp.float32),
    stress: wp.array(dtype=wp.float32),
    # out
    momentum: wp.array(dtype=wp.vec4f),
    impulse: wp.array(dtype=wp.vec4f),
    flags: wp.array(dtype=wp.int32),
):
    """Add one particle's momentum [kg m/s] and mass [kg] to its 27 nodes.

    ``stress`` is volume times Kirchhoff stress [J], (6P,) in the order xx yy zz yz xz xy. With ``split`` what the
    stress gives goes to ``impulse`` instead, so that the velocity before forces is known.
    """
    _scatter(wp.tid(), mass, origin, inv_dx, dx, split, clock, box, x, v, C, stress, momentum, impulse, flags)


@wp.kernel(enable_backward=False)
def grid_to_particles(
    # model
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    adjustment: float,
    separating: wp.float64,
    clear: wp.float64,
    clock: wp.array(dtype=wp.float64),
    box: wp.array(dtype=wp.int32),
    # in
    velocity: wp.array(dtype=wp.vec4f),
    velocity_old: wp.array(dtype=wp.vec4f),
    # in, out
    x: wp.array(dtype=wp.float64),
    v: wp.array(dtype=wp.float32),
    C: wp.array(dtype=wp.float32),
    F: wp.array(dtype=wp.float64),
    # out
    flags: wp.array(dtype=wp.int32),
    extremes: wp.array(dtype=wp.float32),
):
    """Velocity, its gradient, position and trial deformation gradient of one particle after the substep.

    With ``split``: v = sum w v_i + a (v - sum w v_i_old), and the same difference moves the particle where its volume
    ratio exceeds ``separating`` and its height ``clear``, a cell above the ground (ASFLIP, Fei et al. 2021, section 4).
    """
    _gather(
        wp.tid(), origin, inv_dx, dx, split, adjustment, separating, clear, clock, box,
        velocity, velocity_old, x, v, C, F, flags, extremes,
    )  # fmt: skip
