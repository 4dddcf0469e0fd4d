"""Device side of the reverse pass of a stress beside the law: products with its derivatives, model by model.

For a particle with deformation y (F - 1 of a solid, the derivatives of x for a sheet or rod), memory s, numbers p and
fields q, the frame of :mod:`physworld.engine.total.stress_kernels` gives forces A(y, s, p, q) on y and the next memory
B(y, s, p, q). With w the derivative by the forces and sbar' that by the next memory,

    psi = -A : grad w + sbar' . B

and the kernel adds d psi / dy to the nodes, and gives d psi / ds, d psi / dp and d psi / dq. The model is a text of a
few lines with branches in it, so these are central differences: in double precision (whatever the model's own) and
particle by particle, so they are good to eight digits, at the cost of some dozens of calls of the model.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from physworld.engine.lattice.lanes import lanes_double
from physworld.engine.total.stress_kernels import ROD_CORE, SHEET_CORE, SOLID_CORE, StressModel

MOST_NUMBERS = 12  # parameters or fields of one model

_STEP = 1e-6  # of strains and slopes; relative, for numbers and fields

_FRAME = r"""
    const int* node = &cell_nodes.data[cell * NODES];
    const int numbers = parameters.shape[0];
    const int layers = fields.shape[0] / (cells * WIDTH);
    const double* before = &state.data[(long long)row * state.shape[1]];
    for (int q = 0; q < WIDTH; q += LANES) {
        V y[INPUTS], w_slope[INPUTS];
        for (int m = 0; m < INPUTS; ++m) y[m] = w_slope[m] = V{};
        for (int a = 0; a < NODES; ++a)
            for (int k = 0; k < ORDERS; ++k) {
                V g;
                for (int l = 0; l < LANES; ++l) PW_LANE(g, l) = table.data[(ORDERS * a + k) * WIDTH + q + l];
                for (int i = 0; i < 3; ++i) {
                    const int n = 3 * node[a] + i;
                    y[SLOT(k, i)] += (OFFSET) * g * SCALE(k);
                    w_slope[SLOT(k, i)] += w.data[n] * g * SCALE(k);
                }
            }
        V memory[ROWS_OR_ONE], field[MOST], next[ROWS_OR_ONE];
        double number[MOST];
        for (int r = 0; r < ROWS; ++r)
            for (int l = 0; l < LANES; ++l) PW_LANE(memory[r], l) = before[(cell * ROWS + r) * WIDTH + q + l];
        for (int r = 0; r < ROWS; ++r)
            for (int l = 0; l < LANES; ++l) PW_LANE(next[r], l) = state_bar.data[(cell * ROWS + r) * WIDTH + q + l];
        for (int k = 0; k < numbers; ++k) number[k] = parameters.data[k];
        for (int k = 0; k < layers; ++k)
            for (int l = 0; l < LANES; ++l)
                PW_LANE(field[k], l) = fields.data[(k * cells + cell) * WIDTH + q + l];
        auto psi = [&]() -> V {
            V st[ROWS_OR_ONE];
            for (int r = 0; r < ROWS; ++r) st[r] = memory[r];
            V total = V{};
            UNPACK
            CORE
            PACK
            for (int r = 0; r < ROWS; ++r) total += next[r] * st[r];
            return total;
        };
        V y_bar[INPUTS];
        for (int m = 0; m < INPUTS; ++m) {
            const V kept = y[m];
            y[m] = kept + STEP_OF(m);
            const V high = psi();
            y[m] = kept - STEP_OF(m);
            y_bar[m] = (high - psi()) * (0.5 / (STEP_OF(m)));
            y[m] = kept;
        }
        for (int r = 0; r < ROWS; ++r) {
            const V kept = memory[r];
            memory[r] = kept + STEP;
            const V high = psi();
            memory[r] = kept - STEP;
            const V slope = (high - psi()) * (0.5 / STEP);
            memory[r] = kept;
            for (int l = 0; l < LANES; ++l)
                state_bar.data[(cell * ROWS + r) * WIDTH + q + l] = first ? 0.0 : PW_LANE(slope, l);
        }
        for (int k = 0; k < numbers; ++k) {
            const double kept = number[k], size = kept < 0 ? -kept : kept;
            const double step = STEP * (size > 1e-3 ? size : 1e-3);
            number[k] = kept + step;
            const V high = psi();
            number[k] = kept - step;
            const V slope = (high - psi()) * (0.5 / step);
            number[k] = kept;
            PW_ADD(parameters_bar.data[k], lane::sum(slope));
        }
        for (int k = 0; k < layers; ++k) {
            const V kept = field[k];
            double step = 1e-12;
            for (int l = 0; l < LANES; ++l) {
                const double size = PW_LANE(kept, l) < 0 ? -PW_LANE(kept, l) : PW_LANE(kept, l);
                if (STEP * size > step) step = STEP * size;
            }
            field[k] = kept + step;
            const V high = psi();
            field[k] = kept - step;
            const V slope = (high - psi()) * (0.5 / step);
            field[k] = kept;
            for (int l = 0; l < LANES; ++l)
                fields_bar.data[(k * cells + cell) * WIDTH + q + l] += PW_LANE(slope, l);
        }
        for (int a = 0; a < NODES; ++a) {
            V f[3] = {V{}, V{}, V{}};
            for (int k = 0; k < ORDERS; ++k) {
                V g;
                for (int l = 0; l < LANES; ++l) PW_LANE(g, l) = table.data[(ORDERS * a + k) * WIDTH + q + l];
                for (int i = 0; i < 3; ++i) f[i] += y_bar[SLOT(k, i)] * g * SCALE(k);
            }
            for (int i = 0; i < 3; ++i) PW_ADD(x_bar.data[3 * node[a] + i], lane::sum(f[i]));
        }
    }
"""

_MACROS = r"""
    #define FIELD(k) field[k]
    #define STATE(k) st[k]
    #define PARAMETER(k) number[k]
    #define DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
    #define CROSS(u, w, i) ((u)[((i) + 1) % 3] * (w)[((i) + 2) % 3] - (u)[((i) + 2) % 3] * (w)[((i) + 1) % 3])
#if defined(__CUDA_ARCH__)
    #define PW_LANE(v, l) (v)
    #define ROOT(v) ::sqrt(v)
    #define POSITIVE(v) ((v) > 0 ? (v) : 0)
#else
    #define PW_LANE(v, l) (v)[l]
    auto positive_lanes = [](V v) -> V {
        V out;
        for (int k = 0; k < WIDTH; ++k) out[k] = v[k] > 0 ? v[k] : 0;
        return out;
    };
    #define ROOT(v) lane::sqrt(v)
    #define POSITIVE(v) positive_lanes(v)
#endif
"""

_UNDEFINE = "\n".join(
    f"    #undef {name}"
    for name in ("FIELD", "STATE", "PARAMETER", "DOT", "CROSS", "PW_LANE", "ROOT", "POSITIVE")
)

_CARRY = r"""
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
"""

_SHAPES: dict[int, dict[str, str]] = {
    3: {
        "NODES": "27", "WIDTH": "8", "ORDERS": "3", "INPUTS": "9",
        "SLOT(k, i)": "(3 * (i) + (k))", "SCALE(k)": "scale[k]", "OFFSET": "x.data[n] - x_rest.data[n]",
        "STEP_OF(m)": "STEP",
        "UNPACK": "V F[9]; for (int m = 0; m < 9; ++m) F[m] = y[m]; const double scale[3] = {1.0, 1.0, 1.0};",
        "PACK": "for (int m = 0; m < 9; ++m) total += P[m] * w_slope[m] * -1.0;",
    },
    2: {
        "NODES": "9", "WIDTH": "4", "ORDERS": "5", "INPUTS": "15",
        "SLOT(k, i)": "(3 * (k) + (i))", "SCALE(k)": "1.0", "OFFSET": "x.data[n]",
        "STEP_OF(m)": "((m) < 6 ? STEP : 10.0 * STEP)",
        "UNPACK": "V d[5][3]; for (int m = 0; m < 15; ++m) d[m / 3][m % 3] = y[m];",
        "PACK": "for (int m = 0; m < 15; ++m) total += S[m / 3][m % 3] * w_slope[m] * -1.0;",
    },
    1: {
        "NODES": "3", "WIDTH": "2", "ORDERS": "2", "INPUTS": "6",
        "SLOT(k, i)": "(3 * (k) + (i))", "SCALE(k)": "1.0", "OFFSET": "x.data[n]",
        "STEP_OF(m)": "((m) < 3 ? STEP : 10.0 * STEP)",
        "UNPACK": "V t[3] = {y[0], y[1], y[2]}, c[3] = {y[3], y[4], y[5]};",
        "PACK": "for (int i = 0; i < 3; ++i) total += (St[i] * w_slope[i] + Sc[i] * w_slope[3 + i]) * -1.0;",
    },
}  # fmt: skip


def _snippet(model: StressModel) -> str:
    shape = _SHAPES[model.dim]
    core = {3: SOLID_CORE, 2: SHEET_CORE, 1: ROD_CORE}[model.dim].replace("MODEL", model.text)
    if model.dim == 3:
        core = core.replace("float", "double")
    text = _FRAME.replace("UNPACK", shape["UNPACK"]).replace("PACK", shape["PACK"]).replace("CORE", core)
    for name in ("SLOT(k, i)", "SCALE(k)", "STEP_OF(m)", "OFFSET", "NODES", "WIDTH", "ORDERS", "INPUTS"):
        text = text.replace(name, shape[name])
    text = text.replace("ROWS_OR_ONE", str(max(model.rows, 1))).replace("ROWS", str(model.rows))
    text = text.replace("MOST", str(MOST_NUMBERS)).replace("STEP", str(_STEP))
    scale = "    const double scale[3] = {inv_dx0, inv_dx1, inv_dx2};\n" if model.dim == 3 else ""
    width = int(shape["WIDTH"])
    macros = _MACROS.replace("WIDTH", shape["WIDTH"]) + (_CARRY if model.dim == 1 else "")
    end = "\n    #undef CARRY\n" if model.dim == 1 else "\n"
    return lanes_double(width) + macros + scale + text + _UNDEFINE + end


@cache
def stress_adjoint(model: StressModel) -> Any:
    """The kernel of the module's text for one model; memory and its derivatives are in double precision.

    ``state`` holds the memory before every substep of a frame, one row each; ``state_bar`` goes in as the derivative
    by the memory after the substep and comes out as that before it.
    """

    @wp.func_native(_snippet(model))
    def cell_adjoint(
        cell: int,
        # model
        cells: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float64],
        x_rest: wp.array[wp.float64],
        inv_dx0: wp.float64,
        inv_dx1: wp.float64,
        inv_dx2: wp.float64,
        parameters: wp.array[wp.float64],
        fields: wp.array[wp.float64],
        first: int,
        row: int,
        dt: wp.float64,
        # in
        x: wp.array[wp.float64],
        state: wp.array2d[wp.float64],
        w: wp.array[wp.float64],
        # in, out
        state_bar: wp.array[wp.float64],
        # out
        x_bar: wp.array[wp.float64],
        parameters_bar: wp.array[wp.float64],
        fields_bar: wp.array[wp.float64],
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def adjoint(
        # model
        cells: int,
        cell_nodes: wp.array[wp.int32],
        table: wp.array[wp.float64],
        x_rest: wp.array[wp.float64],
        inv_dx: wp.vec3d,
        parameters: wp.array[wp.float64],
        fields: wp.array[wp.float64],
        clock: wp.array[wp.float64],
        counter: wp.array[wp.int32],
        offset: wp.array[wp.int32],
        # in
        x: wp.array[wp.float64],
        state: wp.array2d[wp.float64],
        w: wp.array[wp.float64],
        # in, out
        state_bar: wp.array[wp.float64],
        # out
        x_bar: wp.array[wp.float64],
        parameters_bar: wp.array[wp.float64],
        fields_bar: wp.array[wp.float64],
    ) -> None:
        first = 1 - wp.min(counter[0] + counter[1], 1)
        cell_adjoint(
            wp.tid(), cells, cell_nodes, table, x_rest, inv_dx[0], inv_dx[1], inv_dx[2], parameters, fields, first,
            offset[counter[0]] + counter[1], clock[2], x, state, w, state_bar, x_bar, parameters_bar, fields_bar,
        )  # fmt: skip

    return adjoint
