"""Whole rollouts of a batch of candidates as one native function: no Python and no launch between steps.

Candidates run one after another: a network of this size keeps the arithmetic units busy by itself, and its scratch
stays in the cache. Where the network adds nothing to the prior (``corrected`` is 0) only the prior is run.

Rows of 16 floats are one vector register (two or four of them on older CPUs); every width is padded to a multiple
of 16 with zeros, which a ReLU leaves zero. ``product`` keeps the sums of a tile in registers, so that a weight is read
once for all vertices of the tile: four vertices by 32 columns where registers hold 16 floats, six by 16 where there are
16 registers of 8 (AVX2); fewer sums would wait for each other, more would not stay there. Products are fused with sums
by hand, since Warp's compiler does not contract them.
Equations: ``physworld.worldmodel.model.model``; in the grip's frame ``frame_text``. CPU only.
"""

from __future__ import annotations

import warp as wp

from physworld.worldmodel.native.chain_kernels import CHAIN_ARRAYS, CHAIN_SIZES
from physworld.worldmodel.native.chain_text import STEP, TEXT, VECTORS
from physworld.worldmodel.native.frame_text import FRAME
from physworld.worldmodel.native.nearest_kernels import NEAREST

wp.set_module_options({"enable_backward": False})

SIZES = (
    "candidates", "corrected", "first", "frames", "history", "objects", "vertices", "edges", "layers", "hidden",
    "modes", "controls", "inputs", "places_width", "grounded", "chained", "inertial", "nearest", "framed",
    "shapes", "seen",
    *CHAIN_SIZES,
)  # fmt: skip
SCALARS = ("per_velocity", "change", "per_length", "radius", "longest_rest")
ARRAYS = (
    "paths", "amplitudes", "offsets", "edge_sender", "edge_receiver", "edge_offset", "share",
    "reference", "phis", "softnesses", "mean", "basis", "shape", "prior_weight", "prior_response",
    "encode_in", "encode_in_bias", "encode_out", "encode_out_bias",
    "receive", "receive_bias", "send", "position", "edge_rest", "edge_gap", "gapped",
    "length_weight", "rest_weight", "gap_weight",
    "update_in", "update_in_bias", "update_out", "update_out_bias",
    "decode_in", "decode_in_bias", "decode_out", "decode_out_bias", "skip",
    "features", "places", "state", "hear", "say", "placed", "heard", "sent", "sums", "inner", "correction",
    "length", "regressors", "ahead", "logs", "found", "search_room",
    "frame_shape", "frame_fall", "frame_line", "window",
    "mode_shapes", "mode_middle", "mode_scale", "mode_change", "mode_weight", "mode_parts", "mode_own", "mode_seen",
    "mode_moved", *CHAIN_ARRAYS,
)  # fmt: skip
INTEGER_ARRAYS = frozenset({"offsets", "edge_sender", "edge_receiver", "gapped", "found"})


def _unpack() -> str:
    """C++ that names what the three tables hold."""
    lines = [f"const int {name} = ((const int*)sizes)[{i}];" for i, name in enumerate(SIZES)]
    lines += [f"const float {name} = ((const float*)scalars)[{i}];" for i, name in enumerate(SCALARS)]
    for i, name in enumerate(ARRAYS):
        kind = "int" if name in INTEGER_ARRAYS else "float"
        lines.append(f"{kind}* {name} = ({kind}*)((const long long*)arrays)[{i}];")
    return "\n".join(lines)


_ROLLOUT = (
    VECTORS
    + _unpack()
    + r"""
    const int H = hidden, N = objects, VN = vertices, C = controls, R = modes;
    float* path = paths;
    auto positive = [](V x) -> V { return (V)((I)x & (x > 0.0f)); };
"""
    + TEXT
    + STEP
    + NEAREST
    + FRAME
    + r"""
#if defined(__AVX512F__)
    const int ROWS = 4, COLUMNS = 2;
#else
    const int ROWS = 6, COLUMNS = 1;
#endif
    // out (rows, width) = [out +] in (rows, depth) * weight (depth, width) [+ bias]
    auto product = [&](float* out, const float* in, const float* weight, const float* bias, int rows, int depth,
                      int width, bool add) {
        for (int c = 0; c < width; c += 16 * COLUMNS)
            for (int r = 0; r < rows; r += ROWS) {
                const float* x[ROWS];
                float* y[ROWS];
                int column[COLUMNS];
                V sum[ROWS][COLUMNS];
                #pragma clang loop unroll(full)
                for (int j = 0; j < COLUMNS; ++j) column[j] = c + 16 * j < width ? c + 16 * j : c;
                #pragma clang loop unroll(full)
                for (int i = 0; i < ROWS; ++i) {
                    const long long row = r + i < rows ? r + i : rows - 1;
                    x[i] = in + row * depth;
                    y[i] = out + row * width;
                    #pragma clang loop unroll(full)
                    for (int j = 0; j < COLUMNS; ++j) {
                        sum[i][j] = 0.0f;
                        if (bias) sum[i][j] = *(const V*)(bias + column[j]);
                        if (add) sum[i][j] += *(V*)(y[i] + column[j]);
                    }
                }
                for (int k = 0; k < depth; ++k) {
                    V w[COLUMNS];
                    #pragma clang loop unroll(full)
                    for (int j = 0; j < COLUMNS; ++j) w[j] = *(const V*)(weight + (long long)k * width + column[j]);
                    #pragma clang loop unroll(full)
                    for (int i = 0; i < ROWS; ++i)
                        #pragma clang loop unroll(full)
                        for (int j = 0; j < COLUMNS; ++j) sum[i][j] = fused(x[i][k], w[j], sum[i][j]);
                }
                #pragma clang loop unroll(full)
                for (int i = ROWS - 1; i >= 0; --i)
                    #pragma clang loop unroll(full)
                    for (int j = COLUMNS - 1; j >= 0; --j) *(V*)(y[i] + column[j]) = sum[i][j];
            }
    };
    auto rectify = [&](float* x, int count) {
        for (int c = 0; c < count; c += 16) *(V*)(x + c) = positive(*(V*)(x + c));
    };
    auto centre_of = [&](int t, float* out) {
        out[0] = out[1] = out[2] = 0.0f;
        for (int c = 0; c < C; ++c)
            for (int k = 0; k < 3; ++k) out[k] += path[((long long)t * VN + N + c) * 3 + k] / C;
    };
    auto project = [&](int t) {
        float centre[3];
        centre_of(t, centre);
        for (int m = 0; m < R; ++m) {
            float sum = 0.0f;
            for (int i = 0; i < N; ++i)
                for (int k = 0; k < 3; ++k)
                    sum += basis[((long long)m * N + i) * 3 + k]
                        * (path[((long long)t * VN + i) * 3 + k] - centre[k] - mean[i * 3 + k]);
            amplitudes[(long long)t * R + m] = sum;
        }
    };
    // what the linear map of modes adds to ``next``: physworld.worldmodel.model.modes
    auto add_modes = [&](int t, float* next) {
        const int M = shapes, P = history + 2, W = (3 * P + 15) / 16 * 16, D = (3 * M + 15) / 16 * 16;
        const long long tick = 3LL * VN;
        const float* now = path + t * tick;
        float here[3];
        centre_of(t, here);
        auto part = [&](int p, int v, int k, bool held) -> float {
            const float* x = now + 3 * v + k;
            if (p == 0) return x[0] - here[k];
            if (held) return p == 1 ? ahead[3 * v + k] - x[0] : x[-(p - 2) * tick] - x[-(p - 1) * tick];
            if (p == 1) return x[0] - x[-tick];
            if (p == P - 1) return ahead[3 * v + k] - x[0];
            return x[-(p - 2) * tick] - 2.0f * x[-(p - 1) * tick] + x[-p * tick];
        };
        for (int i = 0; i < N; ++i)
            for (int p = 0; p < P; ++p)
                for (int k = 0; k < 3; ++k) mode_parts[i * W + 3 * p + k] = part(p, i, k, false);
        product(mode_own, mode_shapes, mode_parts, nullptr, M, N, W, false);
        int f = 0;
        for (int p = 0; p < P; ++p)
            for (int r = 0; r < M; ++r)
                for (int k = 0; k < 3; ++k) mode_seen[f++] = mode_own[r * W + 3 * p + k] / N;
        for (int p = 0; p < P; ++p)
            for (int c = 0; c < C; ++c)
                for (int k = 0; k < 3; ++k) mode_seen[f++] = part(p, N + c, k, true);
        for (int j = 0; j < seen; ++j) {
            const float s = (mode_seen[j] - mode_middle[j]) / mode_scale[j];
            mode_seen[j] = s < -3.0f ? -3.0f : (s > 3.0f ? 3.0f : s);
        }
        product(mode_moved, mode_seen, mode_weight, nullptr, 1, seen, D, false);
        for (int r = 0; r < M; ++r)
            for (int k = 0; k < 3; ++k) {
                const float moved = mode_moved[3 * r + k] * mode_change[r];
                for (int i = 0; i < N; ++i) next[3 * i + k] += mode_shapes[r * N + i] * moved;
            }
    };
    for (int b = 0; b < candidates; ++b) {
        float* world = paths + (long long)b * frames * VN * 3;
        path = world;
        const float* phi = phis + (long long)b * N * 2;
        const float softness = softnesses[b];
        if (chained) load(logs + (long long)b * N * 2);
        for (int t = first - history; t < first && !chained && !framed; ++t) project(t);
        for (int t = first; t < frames - 1; ++t) {
            if (framed) {  // the step's window, seen from the grips at its end, stands in for the path
                enter(world + (long long)(t - history) * VN * 3);
                path = window - (long long)(t - history) * VN * 3;
                for (int s = t - history; s < t && !inertial; ++s) project(s);
            }
            const float* now = path + (long long)t * VN * 3;
            float* next = path + (long long)(t + 1) * VN * 3;
            if (chained) {
                chain(t, ahead);
            } else if (inertial) {
                for (int i = 0; i < 3 * N; ++i) ahead[i] = 2.0f * now[i] - now[i - 3LL * VN];
            } else {  // modal prior
                project(t);
                int f = 0;
                for (int s = 0; s <= history; ++s)
                    for (int m = 0; m < R; ++m) regressors[f++] = amplitudes[(long long)(t - s) * R + m];
                float centre[3], here[3], there[3];
                centre_of(t, here);
                centre_of(t + 1, there);
                for (int s = -1; s <= history; ++s) {
                    centre_of(t - s, centre);
                    for (int c = 0; c < C; ++c)
                        for (int k = 0; k < 3; ++k)
                            regressors[f++] =
                                path[((long long)(t - s) * VN + N + c) * 3 + k] - centre[k] - shape[c * 3 + k];
                }
                for (int s = -1; s <= history; ++s) {
                    if (s == 0) continue;
                    centre_of(t - s, centre);
                    for (int k = 0; k < 3; ++k) regressors[f++] = centre[k] - here[k];
                }
                regressors[f++] = 1.0f;
                for (int i = 0; i < N; ++i)
                    for (int k = 0; k < 3; ++k) ahead[i * 3 + k] = there[k] + mean[i * 3 + k];
                for (int m = 0; m < R; ++m) {
                    float a = 0.0f;
                    for (int k = 0; k < f; ++k) a += prior_weight[(long long)m * f + k] * regressors[k];
                    const int lagged = (history + 1) * R;
                    const float* once = prior_response + (long long)m * (lagged + 1);
                    const float* twice = once + (long long)R * (lagged + 1);
                    float answer = once[lagged] + softness * twice[lagged];
                    for (int k = 0; k < lagged; ++k) answer += (once[k] + softness * twice[k]) * regressors[k];
                    a += softness * answer;
                    for (int i = 0; i < 3 * N; ++i) ahead[i] += a * basis[(long long)m * N * 3 + i];
                }
            }
            for (int i = 3 * N; i < 3 * VN; ++i) ahead[i] = next[i];
            if (!corrected) {
                for (int i = 0; i < 3 * N; ++i) next[i] = ahead[i];
                if (framed) leave(next, world + (long long)(t + 1) * VN * 3);
                continue;
            }
            // vertex features, places
            for (int i = 0; i < VN; ++i) {
                float* x = features + (long long)i * inputs;
                float* p = places + (long long)i * places_width;
                int at = 0;
                for (int k = 0; k < 3; ++k) {
                    p[k] = now[i * 3 + k] - reference[i * 3 + k];
                    p[places_width - 3 + k] = reference[i * 3 + k];
                }
                for (int s = 0; s < history; ++s)
                    for (int k = 0; k < 3; ++k) {
                        const float* older = now - (long long)s * VN * 3 + i * 3 + k;
                        const float move = older[0] - older[-(long long)VN * 3];
                        p[3 + at] = move;
                        x[at++] = move * per_velocity;
                    }
                for (int k = 0; k < 3; ++k) x[at++] = (ahead[i * 3 + k] - now[i * 3 + k]) * per_velocity;
                for (int k = 0; k < 2; ++k) x[at++] = i < N ? phi[i * 2 + k] : 0.0f;
                x[at++] = i < N ? 1.0f : 0.0f;
                x[at++] = i < N ? 0.0f : 1.0f;
                if (grounded) {
                    const float height = now[i * 3 + 2] * per_length;
                    x[at++] = height < 0.0f ? 0.0f : (height > 1.0f ? 1.0f : height);
                }
            }
            for (int e = 0; e < edges; ++e) {
                float square = 0.0f;
                for (int k = 0; k < 3; ++k) {
                    const float gap = places[(long long)edge_sender[e] * places_width + k]
                        - places[(long long)edge_receiver[e] * places_width + k] + edge_offset[e * 3 + k];
                    square += gap * gap;
                }
                length[e] = __builtin_sqrtf(square);
            }
            if (nearest) {  // NEAR edges of the places now: those of vertex i lie from edges + i nearest on
                gapped[0] = 0;
                find_nearest(now, N, nearest, radius, edge_sender + edges, found, search_room);
                for (int i = 0; i < N; ++i)
                    for (int e = edges + i * nearest; e < edges + i * nearest + found[i]; ++e) {
                        const float *x = now + 3 * i, *y = now + 3 * edge_sender[e];
                        const float* here = places + (long long)i * places_width;
                        const float* there = places + (long long)edge_sender[e] * places_width;
                        float apart = 0.0f, rest = 0.0f, strain = 0.0f;
                        for (int k = 0; k < 3; ++k) {
                            const float gap = y[k] - x[k], own = there[k] - here[k];
                            const float before = there[places_width - 3 + k] - here[places_width - 3 + k];
                            apart += gap * gap;
                            strain += own * own;
                            rest += before * before;
                        }
                        rest = __builtin_sqrtf(rest);
                        strain = __builtin_sqrtf(strain);
                        length[e] = __builtin_sqrtf(apart);
                        edge_rest[e] = rest < longest_rest ? rest : longest_rest;
                        const float cut = strain > radius ? radius / strain - 1.0f : 0.0f;
                        if (cut != 0.0f) gapped[0] = 1;
                        for (int k = 0; k < 3; ++k) edge_gap[3 * e + k] = cut * (there[k] - here[k]);
                    }
            }
            product(inner, features, encode_in, encode_in_bias, VN, inputs, H, false);
            rectify(inner, VN * H);
            product(state, inner, encode_out, encode_out_bias, VN, H, H, false);
            for (int l = 0; l < layers; ++l) {
                const long long square = (long long)l * H * H;
                product(hear, state, receive + square, receive_bias + l * H, VN, H, H, false);
                product(say, state, send + square, nullptr, VN, H, H, false);
                product(inner, state, update_in + 4 * square, update_in_bias + l * H, VN, H, H, false);
                for (int kind = 0; kind < 3; ++kind) {
                    const int row_of_kind = l * 3 + kind;
                    product(placed, places, position + (long long)row_of_kind * places_width * H, nullptr, VN,
                            places_width, H, false);
                    for (int c = 0; c < VN * H; c += 16) {
                        *(V*)(heard + c) = *(V*)(hear + c) - *(V*)(placed + c);
                        *(V*)(sent + c) = *(V*)(say + c) + *(V*)(placed + c);
                    }
                    for (int i = 0; i < VN; ++i) {
                        const int row = kind * VN + i;
                        int from = offsets[row], to = offsets[row + 1];
                        float part = share[row];
                        if (nearest && kind == 0) {
                            from = edges + i * nearest;
                            to = from + (i < N ? found[i] : 0);
                            part = to > from ? 1.0f / (to - from) : 0.0f;
                        }
                        for (int c = 0; c < H; c += 16) {
                            const V p = *(const V*)(heard + (long long)i * H + c);
                            const V w = *(const V*)(length_weight + row_of_kind * H + c);
                            const V u = *(const V*)(rest_weight + row_of_kind * H + c);
                            V sum = 0.0f;
                            if (gapped[kind]) {
                                const float* G = gap_weight + (long long)row_of_kind * 3 * H + c;
                                const V g0 = *(const V*)G, g1 = *(const V*)(G + H), g2 = *(const V*)(G + 2 * H);
                                for (int e = from; e < to; ++e) {
                                    V m = p + *(const V*)(sent + (long long)edge_sender[e] * H + c);
                                    m = fused(length[e], w, fused(edge_rest[e], u, m));
                                    m = fused(edge_gap[3 * e], g0, m);
                                    m = fused(edge_gap[3 * e + 1], g1, fused(edge_gap[3 * e + 2], g2, m));
                                    sum += positive(m);
                                }
                            } else {
                                for (int e = from; e < to; ++e) {
                                    const V m = p + *(const V*)(sent + (long long)edge_sender[e] * H + c);
                                    sum += positive(fused(length[e], w, fused(edge_rest[e], u, m)));
                                }
                            }
                            *(V*)(sums + (long long)i * H + c) = sum * part;
                        }
                    }
                    product(inner, sums, update_in + 4 * square + (1 + kind) * H * H, nullptr, VN, H, H, true);
                }
                rectify(inner, VN * H);
                product(state, inner, update_out + square, update_out_bias + l * H, VN, H, H, true);
            }
            product(inner, state, decode_in, decode_in_bias, N, H, H, false);
            rectify(inner, N * H);
            product(correction, inner, decode_out, decode_out_bias, N, H, 16, false);
            product(correction, features, skip, nullptr, N, inputs, 16, true);
            for (int i = 0; i < N; ++i)
                for (int k = 0; k < 3; ++k) next[i * 3 + k] = ahead[i * 3 + k] + change * correction[i * 16 + k];
            if (shapes) add_modes(t, next);
            if (framed) leave(next, world + (long long)(t + 1) * VN * 3);
        }
    }
"""
)


@wp.func_native(_ROLLOUT)
def rollout_rows(sizes: wp.uint64, scalars: wp.uint64, arrays: wp.uint64) -> None: ...


@wp.kernel
def rollout(sizes: wp.uint64, scalars: wp.uint64, arrays: wp.uint64) -> None:
    """Launch with dim 1: addresses of the int32 sizes, the float32 scalars and the table of array addresses."""
    rollout_rows(sizes, scalars, arrays)
