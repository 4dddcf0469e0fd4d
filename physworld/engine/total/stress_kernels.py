"""Device side of stresses beside a law's own: one frame of native code a dimension, into which a model is set.

The frame finds the strains of a cell's particles and spreads the model's stresses over the nodes, as
:mod:`physworld.engine.total.solid_kernels`, ``sheet_kernels`` and ``rod_kernels`` do; the model is a few lines on
vectors V:

    solid   given E[6], Green strain in the order xx yy zz yz xz xy
            to set S[6], second Piola-Kirchhoff stress times volume; P = F S
    sheet   given strain[6] = e11 e22 e12 k11 k22 k12
            to set stress[6] = N11 N22 N12 M11 M22 M12 times area
    rod     given stretch = |x'| - 1, kappa[3] = x' x x'' / |x'|^3
            to set axial [N], moment[3] [N m] times length, and torque[3], what turns with the tangent (see below)

FIELD(k) is the k-th field of the particles, FIELD(0) their measure times the stiffness factor; STATE(k) the k-th row
of memory; PARAMETER(k) a number; ROOT and POSITIVE the square root and the positive part of a vector; ``dt`` the
substep [s]; ``first`` is 1 in the first substep of a run.

A rod carries vectors of its cross-section: CARRY(a, b, c) turns the rows a, b, c of memory with the tangent since the
last substep (the least rotation; Bergou et al. 2008) and keeps the tangent in the first three rows. Spin about the
tangent is not carried: the rod has no twist. An energy B/2 |kappa - p|^2 with a carried p has moment B (kappa - p) and
torque p x moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from physworld.engine.lattice.lanes import lanes_double, lanes_float8

ROWS = r"""
    #define FIELD(k) (*(const V*)&fields.data[((k) * cells + cell) * WIDTH + q])
    #define STATE(k) (*(V*)&state.data[(cell * rows + (k)) * WIDTH + q])
    #define PARAMETER(k) parameters.data[k]
#if defined(__CUDA_ARCH__)
    #define ROOT(v) sqrt(v)
    #define POSITIVE(v) ((v) > 0 ? (v) : 0)
#else
    auto root_lanes = [](V v) -> V {
        V out;
        for (int k = 0; k < WIDTH; ++k) out[k] = sqrt(v[k]);
        return out;
    };
    auto positive_lanes = [](V v) -> V {
        V out;
        for (int k = 0; k < WIDTH; ++k) out[k] = v[k] > 0 ? v[k] : 0;
        return out;
    };
    #define ROOT(v) root_lanes(v)
    #define POSITIVE(v) positive_lanes(v)
#endif
"""

SOLID_CORE = r"""
        V E[6], S[6];   // E = (H + H^T + H^T H) / 2 with H = F - 1, before the 1 is added: small strains keep digits
        for (int k = 0; k < 6; ++k) {
            const int i = k < 3 ? k : (k == 3 ? 1 : 0);
            const int j = k < 3 ? k : (k == 5 ? 1 : 2);
            E[k] = 0.5f * (F[3 * i + j] + F[3 * j + i] + F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j]);
            S[k] = V{};
        }
        for (int i = 0; i < 3; ++i) F[4 * i] += 1.0f;
        {
MODEL
        }
        V P[9];
        for (int i = 0; i < 3; ++i) {
            P[3 * i + 0] = (F[3 * i] * S[0] + F[3 * i + 1] * S[5] + F[3 * i + 2] * S[4]) * scale[0];
            P[3 * i + 1] = (F[3 * i] * S[5] + F[3 * i + 1] * S[1] + F[3 * i + 2] * S[3]) * scale[1];
            P[3 * i + 2] = (F[3 * i] * S[4] + F[3 * i + 1] * S[3] + F[3 * i + 2] * S[2]) * scale[2];
        }
"""

_SOLID = (
    lanes_float8()
    + ROWS.replace("WIDTH", "8")
    + r"""
    const int* node = &cell_nodes.data[cell * 27];
    const double* anchor = &x.data[3 * node[13]];
    const double* anchor_rest = &x_rest.data[3 * node[13]];
    float u[27 * 3];
    for (int a = 0; a < 27; ++a)
        for (int i = 0; i < 3; ++i) {
            const int k = 3 * node[a] + i;
            u[3 * a + i] = (float)((x.data[k] - anchor[i]) - (x_rest.data[k] - anchor_rest[i]));
        }
    const float scale[3] = {inv_dx0, inv_dx1, inv_dx2};
    for (int q = 0; q < 8; q += LANES) {
        V F[9];
        for (int k = 0; k < 9; ++k) F[k] = V{};
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&table.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&table.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&table.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const float ui = u[3 * a + i];
                F[3 * i + 0] += ui * g0;
                F[3 * i + 1] += ui * g1;
                F[3 * i + 2] += ui * g2;
            }
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) F[3 * i + j] = F[3 * i + j] * scale[j];
"""
    + SOLID_CORE
    + r"""
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&table.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&table.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&table.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const V t = P[3 * i] * g0 + P[3 * i + 1] * g1 + P[3 * i + 2] * g2;
                PW_ADD(force.data[3 * node[a] + i], -lane::sum(t));
            }
        }
    }
    #undef FIELD
    #undef STATE
    #undef PARAMETER
    #undef ROOT
    #undef POSITIVE
"""
)

SHEET_CORE = r"""
        const V g11 = DOT(d[0], d[0]), g22 = DOT(d[1], d[1]), g12 = DOT(d[0], d[1]);
        V n[3] = {d[0][1] * d[1][2] - d[0][2] * d[1][1], d[0][2] * d[1][0] - d[0][0] * d[1][2],
                  d[0][0] * d[1][1] - d[0][1] * d[1][0]};
        const V area2 = DOT(n, n) + 1e-24;
        const V inv_area = 1.0 / lane::sqrt(area2);
        for (int i = 0; i < 3; ++i) n[i] = n[i] * inv_area;
        const V strain[6] = {0.5 * (g11 - 1.0), 0.5 * (g22 - 1.0), 0.5 * g12, DOT(n, d[2]), DOT(n, d[3]), DOT(n, d[4])};
        V stress[6] = {V{}, V{}, V{}, V{}, V{}, V{}};
        {
MODEL
        }
        const V inv_det = 1.0 / area2;
        V s1 = V{}, s2 = V{};
        for (int i = 0; i < 3; ++i) {
            const V load = stress[3] * d[2][i] + stress[4] * d[3][i] + 2.0 * stress[5] * d[4][i];
            s1 += load * (g22 * d[0][i] - g12 * d[1][i]) * inv_det;
            s2 += load * (g11 * d[1][i] - g12 * d[0][i]) * inv_det;
        }
        V S[5][3];
        for (int i = 0; i < 3; ++i) {
            S[0][i] = stress[0] * d[0][i] + stress[2] * d[1][i] - s1 * n[i];
            S[1][i] = stress[1] * d[1][i] + stress[2] * d[0][i] - s2 * n[i];
            S[2][i] = stress[3] * n[i];
            S[3][i] = stress[4] * n[i];
            S[4][i] = 2.0 * stress[5] * n[i];
        }
"""

_SHEET = (
    lanes_double(4)
    + ROWS.replace("WIDTH", "4")
    + r"""
    const int* node = &cell_nodes.data[cell * 9];
    #define DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
    for (int q = 0; q < 4; q += LANES) {
        V d[5][3];   // a1, a2, x,11, x,22, x,12
        for (int k = 0; k < 5; ++k)
            for (int i = 0; i < 3; ++i) d[k][i] = V{};
        for (int a = 0; a < 9; ++a)
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&table.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) d[k][i] += x.data[3 * node[a] + i] * g;
            }
"""
    + SHEET_CORE
    + r"""
        for (int a = 0; a < 9; ++a) {
            V f[3] = {V{}, V{}, V{}};
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&table.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) f[i] += S[k][i] * g;
            }
            for (int i = 0; i < 3; ++i) PW_ADD(force.data[3 * node[a] + i], -lane::sum(f[i]));
        }
    }
    #undef DOT
    #undef FIELD
    #undef STATE
    #undef PARAMETER
    #undef ROOT
    #undef POSITIVE
"""
)

ROD_CORE = r"""
        const V a2 = DOT(t, t) + 1e-24;
        const V length = lane::sqrt(a2);
        const V inv_length = 1.0 / length;
        const V inv_a2 = inv_length * inv_length;
        const V inv_a3 = inv_a2 * inv_length;
        const V stretch = length - 1.0;
        V kappa[3], moment[3] = {V{}, V{}, V{}}, torque[3] = {V{}, V{}, V{}}, axial = V{};
        for (int i = 0; i < 3; ++i) kappa[i] = CROSS(t, c, i) * inv_a3;
        {
MODEL
        }
        const V along = axial * inv_length - 3.0 * DOT(moment, kappa) * inv_a2;
        V St[3], Sc[3];
        for (int i = 0; i < 3; ++i) {
            St[i] = CROSS(c, moment, i) * inv_a3 + along * t[i] - CROSS(torque, t, i) * inv_a2;
            Sc[i] = CROSS(moment, t, i) * inv_a3;
        }
"""

_ROD = (
    lanes_double(2)
    + ROWS.replace("WIDTH", "2")
    + r"""
    const int* node = &cell_nodes.data[cell * 3];
    #define DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
    #define CROSS(u, w, i) ((u)[((i) + 1) % 3] * (w)[((i) + 2) % 3] - (u)[((i) + 2) % 3] * (w)[((i) + 1) % 3])
    #define CARRY(a, b, c) { \
        V unit[3], turn[3], old[3] = {STATE(a), STATE(b), STATE(c)}, once[3]; \
        for (int i = 0; i < 3; ++i) unit[i] = t[i] * inv_length; \
        const V last[3] = {STATE(0), STATE(1), STATE(2)}; \
        for (int i = 0; i < 3; ++i) turn[i] = first ? V{} : CROSS(last, unit, i); \
        const V half = 1.0 / (1.0 + (first ? V{} : DOT(last, unit))); \
        for (int i = 0; i < 3; ++i) once[i] = CROSS(turn, old, i); \
        STATE(a) = old[0] + once[0] + half * CROSS(turn, once, 0); \
        STATE(b) = old[1] + once[1] + half * CROSS(turn, once, 1); \
        STATE(c) = old[2] + once[2] + half * CROSS(turn, once, 2); \
        for (int i = 0; i < 3; ++i) STATE(i) = unit[i]; }
    for (int q = 0; q < 2; q += LANES) {
        V t[3] = {V{}, V{}, V{}}, c[3] = {V{}, V{}, V{}};
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&table.data[(2 * a) * 2 + q];
            const V h = *(const V*)&table.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i) {
                t[i] += x.data[3 * node[a] + i] * g;
                c[i] += x.data[3 * node[a] + i] * h;
            }
        }
"""
    + ROD_CORE
    + r"""
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&table.data[(2 * a) * 2 + q];
            const V h = *(const V*)&table.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i) PW_ADD(force.data[3 * node[a] + i], -lane::sum(St[i] * g + Sc[i] * h));
        }
    }
    #undef CARRY
    #undef CROSS
    #undef DOT
    #undef FIELD
    #undef STATE
    #undef PARAMETER
    #undef ROOT
    #undef POSITIVE
"""
)


@dataclass(frozen=True)
class StressModel:
    """A kernel that adds a model's forces, for bodies of dimension ``dim``; ``rows`` rows of memory a particle.

    ``text`` is the model's own, for whoever differentiates it.
    """

    dim: int
    rows: int
    kernel: Any
    text: str


def solid_model(model: str, rows: int = 0) -> StressModel:
    """A solid's frame around ``model``, code that sets S from E."""

    @wp.func_native(_SOLID.replace("MODEL", model))
    def cell_stress(
        cell: int,
        # model
        cells: int,
        rows: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float32],
        x_rest: wp.array[wp.float64],
        inv_dx0: float,
        inv_dx1: float,
        inv_dx2: float,
        parameters: wp.array[wp.float32],
        fields: wp.array[wp.float32],
        first: int,
        dt: float,
        # in
        x: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float32],
        # out
        force: wp.array[wp.float64],
    ) -> None: ...

    @wp.kernel(module="unique")
    def stress_forces(
        # model
        cells: int,
        rows: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float32],
        x_rest: wp.array[wp.float64],
        inv_dx: wp.vec3f,
        parameters: wp.array[wp.float32],
        fields: wp.array[wp.float32],
        clock: wp.array[wp.float64],
        counter: wp.array[wp.int32],
        # in
        x: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float32],
        # out
        force: wp.array[wp.float64],
    ) -> None:
        first = wp.where(counter[0] + counter[1] == 0, 1, 0)
        cell_stress(
            wp.tid(), cells, rows, cell_nodes, table, x_rest, inv_dx[0], inv_dx[1], inv_dx[2], parameters,
            fields, first, wp.float32(clock[2]), x, state, force,
        )  # fmt: skip

    return StressModel(3, rows, stress_forces, model)


def sheet_model(model: str, rows: int = 0) -> StressModel:
    """A sheet's frame around ``model``, code that sets stress from strain."""
    return _thin_model(2, _SHEET, model, rows)


def rod_model(model: str, rows: int = 0) -> StressModel:
    """A rod's frame around ``model``, code that sets axial, moment and torque from stretch and kappa."""
    return _thin_model(1, _ROD, model, rows)


def _thin_model(dim: int, frame: str, model: str, rows: int) -> StressModel:
    @wp.func_native(frame.replace("MODEL", model))
    def cell_stress(
        cell: int,
        # model
        cells: int,
        rows: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float64],
        parameters: wp.array[wp.float64],
        fields: wp.array[wp.float64],
        first: int,
        dt: wp.float64,
        # in
        x: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float64],
        # out
        force: wp.array[wp.float64],
    ) -> None: ...

    @wp.kernel(module="unique")
    def stress_forces(
        # model
        cells: int,
        rows: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float64],
        parameters: wp.array[wp.float64],
        fields: wp.array[wp.float64],
        clock: wp.array[wp.float64],
        counter: wp.array[wp.int32],
        # in
        x: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float64],
        # out
        force: wp.array[wp.float64],
    ) -> None:
        first = wp.where(counter[0] + counter[1] == 0, 1, 0)
        cell_stress(
            wp.tid(), cells, rows, cell_nodes, table, parameters, fields, first, clock[2], x, state, force
        )

    return StressModel(dim, rows, stress_forces, model)
