"""Device side of the transfers of updated Lagrangian MPM: particles to grid and back, quadratic B-splines.

    p2g   m_i += w m      p_i += w (m v + (m C - dt V tau D^-1)(x_i - x))          MLS-MPM, Hu et al. 2018
    g2p   v = sum w v_i   C = sum w v_i (x_i - x)^T D^-1    D = dx^2 / 4           APIC, Jiang et al. 2015

The grid is a flat box of nodes (momentum, mass), four floats each, z fastest. The three nodes of a row are twelve
neighbouring floats: on a CPU a vector of eight and one of four take a row, and a transfer is nine rows; a thread takes
``group`` particles in turn. On CUDA one thread loops over the 27 nodes and adds atomically. Cell c spans [c, c + 1] dx
from the grid's origin, its node sits in the middle (:mod:`physworld.engine.lattice.bspline`).

Positions are double precision (small increments of a slow motion would be rounded away), velocities and the
grid single.

Legend: t local coordinate in the cell, w weights, d distances to the three nodes, Q affine momentum, box = first cell
(3) and nodes (3) of the box an axis and the width of its rim; flags: see ``RIM`` to ``INVERTED``.
"""

from __future__ import annotations

import warp as wp

# Places in ``flags``; ``extremes[0]`` has the cells crossed in a substep.
RIM, ESCAPED, NOT_FINITE, INVERTED = 0, 1, 2, 3

_LOCATE = r"""
    for (int p = group * turn; p < group * (turn + 1) && p < count; ++p) {
    const int n0 = box.data[3], n1 = box.data[4], n2 = box.data[5], rim = box.data[6];
    int b[3];
    float w[3][3], d[3][3];
    bool inside = true, near = false, finite = true;
    for (int j = 0; j < 3; ++j) {
        const double s = (x.data[3 * p + j] - origin[j]) * (double)inv_dx[j];
        if (!(s > -1.0e9 && s < 1.0e9)) { flags.data[2] = 1; finite = false; break; }
        int cell = (int)s;
        cell -= s < (double)cell;
        const float t = (float)(s - (double)cell);
        b[j] = cell - 1 - box.data[j];
        w[j][0] = 0.5f * (1.0f - t) * (1.0f - t);
        w[j][1] = 0.5f + t - t * t;
        w[j][2] = 0.5f * t * t;
        for (int a = 0; a < 3; ++a) d[j][a] = ((float)a - 0.5f - t) * dx[j];
        inside = inside && b[j] >= 0 && b[j] + 2 < box.data[3 + j];
        near = near || b[j] < rim || b[j] + 2 >= box.data[3 + j] - rim;
    }
    if (!finite) continue;
    if (!inside) { flags.data[1] = 1; continue; }
"""

_ROW = r"""
#if !defined(__CUDA_ARCH__)
    typedef float V8 __attribute__((vector_size(32), aligned(4)));
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    auto twice = [](V4 q) __attribute__((always_inline)) -> V8 {
        return __builtin_shufflevector(q, q, 0, 1, 2, 3, 0, 1, 2, 3);
    };
    auto pair = [](float a, float b) __attribute__((always_inline)) -> V8 { return V8{a, a, a, a, b, b, b, b}; };
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
    const V8 w8 = pair(w[2][0], w[2][1]), d8 = pair(d[2][0], d[2][1]);
    const float w4 = w[2][2], d4 = d[2][2];
    auto spread = [&](const float* A, V4 base, float* target) __attribute__((always_inline)) {
        const V4 ax = V4{A[0], A[3], A[6], 0.0f}, ay = V4{A[1], A[4], A[7], 0.0f}, az = V4{A[2], A[5], A[8], 0.0f};
        const V8 first8 = w8 * (twice(base) + twice(az) * d8), ax8 = w8 * twice(ax), ay8 = w8 * twice(ay);
        const V4 first4 = w4 * (base + az * d4), ax4 = w4 * ax, ay4 = w4 * ay;
        for (int i = 0; i < 3; ++i) {
            const V8 plane8 = (first8 + ax8 * d[0][i]) * w[0][i], tilt8 = ay8 * w[0][i];
            const V4 plane4 = (first4 + ax4 * d[0][i]) * w[0][i], tilt4 = ay4 * w[0][i];
            float* at = target + 4 * (((b[0] + i) * n1 + b[1]) * n2 + b[2]);
            for (int j = 0; j < 3; ++j, at += 4 * n2) {
                *(V8*)at = *(V8*)at + (plane8 + tilt8 * d[1][j]) * w[1][j];
                *(V4*)(at + 8) = *(V4*)(at + 8) + (plane4 + tilt4 * d[1][j]) * w[1][j];
            }
        }
    };
    spread(Q, V4{mv[0], mv[1], mv[2], m}, grid);
    if (split) spread(S, V4{}, push);
#endif
    }
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
    float wd[3], xd[3];
    for (int j = 0; j < 3; ++j) {
        wd[j] = w[1][j] * d[1][j];
        xd[j] = w[0][j] * d[0][j];
    }
    V8 sum8 = V8{}, x8 = V8{}, y8 = V8{}, o8 = V8{};
    V4 sum4 = V4{}, x4 = V4{}, y4 = V4{}, o4 = V4{};
    for (int i = 0; i < 3; ++i) {
        const int row = 4 * (((b[0] + i) * n1 + b[1]) * n2 + b[2]);
        V8 plane8 = V8{}, tilt8 = V8{}, before8 = V8{};
        V4 plane4 = V4{}, tilt4 = V4{}, before4 = V4{};
        for (int j = 0; j < 3; ++j) {
            const V8 r8 = *(const V8*)(grid + row + 4 * j * n2);
            const V4 r4 = *(const V4*)(grid + row + 4 * j * n2 + 8);
            plane8 += r8 * w[1][j];
            plane4 += r4 * w[1][j];
            tilt8 += r8 * wd[j];
            tilt4 += r4 * wd[j];
            if (split) {
                before8 += *(const V8*)(old + row + 4 * j * n2) * w[1][j];
                before4 += *(const V4*)(old + row + 4 * j * n2 + 8) * w[1][j];
            }
        }
        sum8 += plane8 * w[0][i];
        sum4 += plane4 * w[0][i];
        x8 += plane8 * xd[i];
        x4 += plane4 * xd[i];
        y8 += tilt8 * w[0][i];
        y4 += tilt4 * w[0][i];
        if (split) {
            o8 += before8 * w[0][i];
            o4 += before4 * w[0][i];
        }
    }
    const V8 w8 = pair(w[2][0], w[2][1]), wd8 = pair(w[2][0] * d[2][0], w[2][1] * d[2][1]);
    const float w4 = w[2][2], wd4 = w[2][2] * d[2][2];
    auto fold = [](V8 p, V4 q) __attribute__((always_inline)) -> V4 {
        return __builtin_shufflevector(p, p, 0, 1, 2, 3) + __builtin_shufflevector(p, p, 4, 5, 6, 7) + q;
    };
    const V4 f = fold(sum8 * w8, sum4 * w4), fx = fold(x8 * w8, x4 * w4), fy = fold(y8 * w8, y4 * w4);
    const V4 fz = fold(sum8 * wd8, sum4 * wd4);
    for (int a = 0; a < 3; ++a) {
        nv[a] = f[a];
        A[3 * a] = fx[a];
        A[3 * a + 1] = fy[a];
        A[3 * a + 2] = fz[a];
    }
    if (split) {
        const V4 fo = fold(o8 * w8, o4 * w4);
        for (int a = 0; a < 3; ++a) ov[a] = fo[a];
    }
#endif
    for (int a = 0; a < 3; ++a)
        for (int j = 0; j < 3; ++j) A[3 * a + j] *= 4.0f * inv_dx[j] * inv_dx[j];
    for (int k = 0; k < 9; ++k) C.data[9 * p + k] = A[k];
    float keep = 0.0f, shift = 0.0f;
    if (split) {
        keep = adjustment;
        const float opened = ratio.data[p] * (1.0f + (float)dt * (A[0] + A[4] + A[8]));
        shift = opened > separating && x.data[3 * p + 2] > clear ? adjustment : 0.0f;
    }
    float most = 0.0f;
    for (int j = 0; j < 3; ++j) {
        const float difference = split ? v.data[3 * p + j] - ov[j] : 0.0f;
        const double step = dt * ((double)nv[j] + (double)(shift * difference));
        v.data[3 * p + j] = nv[j] + keep * difference;
        x.data[3 * p + j] += step;
        const float along = (float)step * inv_dx[j];
        const float crossed = along < 0.0f ? -along : along;
        if (!(crossed < 1.0e9f)) flags.data[2] = 1;
        most = crossed > most ? crossed : most;
    }
#if defined(__CUDA_ARCH__)
    atomicMax((int*)&extremes.data[0], __float_as_int(most));   // non-negative floats order like their bits
#else
    if (most > extremes.data[0]) extremes.data[0] = most;
#endif
    }
"""
)


@wp.func_native(_SCATTER)
def _scatter(
    turn: int,
    group: int,
    count: int,
    # model
    mass: wp.array[wp.float32],
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float32],
    C: wp.array[wp.float32],
    stress: wp.array[wp.float32],
    # out
    momentum: wp.array[wp.vec4f],
    impulse: wp.array[wp.vec4f],
    flags: wp.array[wp.int32],
) -> None: ...


@wp.func_native(_GATHER)
def _gather(
    turn: int,
    group: int,
    count: int,
    # model
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    adjustment: float,
    separating: float,
    clear: wp.float64,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in
    velocity: wp.array[wp.vec4f],
    velocity_old: wp.array[wp.vec4f],
    ratio: wp.array[wp.float32],
    # in, out
    x: wp.array[wp.float64],
    v: wp.array[wp.float32],
    C: wp.array[wp.float32],
    # out
    flags: wp.array[wp.int32],
    extremes: wp.array[wp.float32],
) -> None: ...


@wp.kernel(enable_backward=False)
def particles_to_grid(
    group: int,
    count: int,
    # model
    mass: wp.array[wp.float32],
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float32],
    C: wp.array[wp.float32],
    stress: wp.array[wp.float32],
    # out
    momentum: wp.array[wp.vec4f],
    impulse: wp.array[wp.vec4f],
    flags: wp.array[wp.int32],
) -> None:
    """Add one particle's momentum [kg m/s] and mass [kg] to its 27 nodes.

    ``stress`` is volume times Kirchhoff stress [J], (6P,) in the order xx yy zz yz xz xy. With ``split`` what the
    stress gives goes to ``impulse`` instead, so that the velocity before forces is known.
    """
    _scatter(
        wp.tid(),
        group,
        count,
        mass,
        origin,
        inv_dx,
        dx,
        split,
        clock,
        box,
        x,
        v,
        C,
        stress,
        momentum,
        impulse,
        flags,
    )


@wp.kernel(enable_backward=False)
def grid_to_particles(
    group: int,
    count: int,
    # model
    origin: wp.vec3d,
    inv_dx: wp.vec3f,
    dx: wp.vec3f,
    split: int,
    adjustment: float,
    separating: float,
    clear: wp.float64,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in
    velocity: wp.array[wp.vec4f],
    velocity_old: wp.array[wp.vec4f],
    ratio: wp.array[wp.float32],
    # in, out
    x: wp.array[wp.float64],
    v: wp.array[wp.float32],
    C: wp.array[wp.float32],
    # out
    flags: wp.array[wp.int32],
    extremes: wp.array[wp.float32],
) -> None:
    """Velocity, its gradient and position of one particle after the substep.

    With ``split``: v = sum w v_i + a (v - sum w v_i_old), and the same difference moves the particle where its elastic
    volume ratio exceeds ``separating`` and its height ``clear``, a cell above the ground (ASFLIP, Fei et al.
    2021, section 4).
    """
    _gather(
        wp.tid(), group, count, origin, inv_dx, dx, split, adjustment, separating, clear, clock, box,
        velocity, velocity_old, ratio, x, v, C, flags, extremes,
    )  # fmt: skip
