"""Warp kernels of the mean message and its adjoint, in native rows of sixteen hidden channels.

    out[i, b, :] = mean_e relu(heard[i, b, :] + sent[s_e, b, :] + bias[e, :] + length[e, b] · weight[k, :])

over the edges e of receiver i, which lie together, 0 where there are none; receivers come in groups of equal size, and
k is the group of i. Nothing of the size (edges, batch, hidden) is ever stored:
the adjoint computes the terms again. One thread walks all receivers, so the adjoint's scatter needs no
atomics; arguments are addresses, since building an array wrapper costs more than the sum itself. CPU only;
``messages.py`` holds the plain torch form for other devices.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

_PREAMBLE = r"""
    typedef float V __attribute__((ext_vector_type(16), aligned(4)));
    typedef int I __attribute__((ext_vector_type(16), aligned(4)));
    const int* first = (const int*)offsets;
    const int* sender = (const int*)senders;
    const float* P = (const float*)heard;
    const float* Q = (const float*)sent;
    const float* S = (const float*)bias;
    const float* R = (const float*)length;
    const int group = vertices / kinds;
    const int whole = hidden / 16 * 16;
    auto share = [&](int i) { return first[i + 1] > first[i] ? 1.0f / (first[i + 1] - first[i]) : 0.0f; };
"""

_FORWARD = (
    _PREAMBLE
    + r"""
    float* O = (float*)out;
    for (int i = 0; i < vertices; ++i)
        for (int b = 0; b < batch; ++b) {
            const long long row = (long long)(i * batch + b) * hidden;
            const float* W = (const float*)weight + i / group * hidden;
            for (int c = 0; c < whole; c += 16) {
                const V p = *(const V*)(P + row + c);
                const V w = *(const V*)(W + c);
                V sum = 0.0f;
                for (int e = first[i]; e < first[i + 1]; ++e) {
                    const V q = *(const V*)(Q + (long long)(sender[e] * batch + b) * hidden + c);
                    const V s = *(const V*)(S + (long long)e * hidden + c);
                    const V m = p + q + s + R[e * batch + b] * w;
                    sum += (V)((I)m & (m > 0.0f));
                }
                *(V*)(O + row + c) = share(i) * sum;
            }
            for (int c = whole; c < hidden; ++c) {
                float sum = 0.0f;
                for (int e = first[i]; e < first[i + 1]; ++e) {
                    const float m = P[row + c] + Q[(long long)(sender[e] * batch + b) * hidden + c]
                        + S[(long long)e * hidden + c] + R[e * batch + b] * W[c];
                    sum += m > 0.0f ? m : 0.0f;
                }
                O[row + c] = share(i) * sum;
            }
        }
"""
)

_ADJOINT = (
    _PREAMBLE
    + r"""
    const float* G = (const float*)grad;
    float* dP = (float*)grad_heard;
    float* dQ = (float*)grad_sent;
    float* dS = (float*)grad_bias;
    float* dR = (float*)grad_length;
#if defined(__AVX512F__)
    typedef char Block[4];  // rows of 16 channels whose sums over the edges of a receiver fit into the registers
#else
    typedef char Block[1];
#endif
    auto rows = [&](auto* block, int i, int b, int c) {
        constexpr int N = sizeof(*block);
        const long long row = (long long)(i * batch + b) * hidden + c;
        const int kind = i / group * hidden + c;
        V p[N], w[N], g[N], dp[N], dw[N];
        for (int n = 0; n < N; ++n) {
            p[n] = *(const V*)(P + row + 16 * n);
            g[n] = share(i) * *(const V*)(G + row + 16 * n);
            w[n] = *(const V*)((const float*)weight + kind + 16 * n);
            dp[n] = dw[n] = 0.0f;
        }
        for (int e = first[i]; e < first[i + 1]; ++e) {
            const long long q = (long long)(sender[e] * batch + b) * hidden + c;
            const long long s = (long long)e * hidden + c;
            const float r = R[e * batch + b];
            V along = 0.0f;
            for (int n = 0; n < N; ++n) {
                const V m = p[n] + *(const V*)(Q + q + 16 * n) + *(const V*)(S + s + 16 * n) + r * w[n];
                const V passed = (V)((I)g[n] & (m > 0.0f));
                *(V*)(dQ + q + 16 * n) += passed;
                *(V*)(dS + s + 16 * n) += passed;
                dp[n] += passed;
                dw[n] += r * passed;
                along += passed * w[n];
            }
            const auto eight = along.lo + along.hi;
            const auto four = eight.lo + eight.hi;
            const auto two = four.lo + four.hi;
            dR[e * batch + b] += two.x + two.y;
        }
        for (int n = 0; n < N; ++n) {
            *(V*)(dP + row + 16 * n) = dp[n];
            *(V*)((float*)grad_weight + kind + 16 * n) += dw[n];
        }
    };
    for (int i = 0; i < vertices; ++i)
        for (int b = 0; b < batch; ++b) {
            int c = 0;
            for (; c + 16 * (int)sizeof(Block) <= whole; c += 16 * sizeof(Block)) rows((Block*)nullptr, i, b, c);
            for (; c < whole; c += 16) rows((char(*)[1]) nullptr, i, b, c);
            const long long row = (long long)(i * batch + b) * hidden;
            const float* W = (const float*)weight + i / group * hidden;
            float* dW = (float*)grad_weight + i / group * hidden;
            for (; c < hidden; ++c) {
                float sum = 0.0f;
                for (int e = first[i]; e < first[i + 1]; ++e) {
                    const long long q = (long long)(sender[e] * batch + b) * hidden + c;
                    const long long s = (long long)e * hidden + c;
                    const float r = R[e * batch + b];
                    const float g = P[row + c] + Q[q] + S[s] + r * W[c] > 0.0f ? share(i) * G[row + c] : 0.0f;
                    dQ[q] += g;
                    dS[s] += g;
                    dW[c] += r * g;
                    dR[e * batch + b] += g * W[c];
                    sum += g;
                }
                dP[row + c] = sum;
            }
        }
"""
)


@wp.func_native(_FORWARD)
def message_mean_rows(
    # sizes
    vertices: wp.int32,
    batch: wp.int32,
    hidden: wp.int32,
    kinds: wp.int32,
    # graph
    offsets: wp.uint64,
    senders: wp.uint64,
    # in
    heard: wp.uint64,
    sent: wp.uint64,
    bias: wp.uint64,
    length: wp.uint64,
    weight: wp.uint64,
    # out
    out: wp.uint64,
) -> None: ...


@wp.func_native(_ADJOINT)
def message_mean_adjoint_rows(
    # sizes
    vertices: wp.int32,
    batch: wp.int32,
    hidden: wp.int32,
    kinds: wp.int32,
    # graph
    offsets: wp.uint64,
    senders: wp.uint64,
    # in
    heard: wp.uint64,
    sent: wp.uint64,
    bias: wp.uint64,
    length: wp.uint64,
    weight: wp.uint64,
    grad: wp.uint64,
    # out
    grad_heard: wp.uint64,
    grad_sent: wp.uint64,
    grad_bias: wp.uint64,
    grad_length: wp.uint64,
    grad_weight: wp.uint64,
) -> None: ...


@wp.kernel
def message_mean(
    # sizes
    vertices: wp.int32,
    batch: wp.int32,
    hidden: wp.int32,
    kinds: wp.int32,
    # graph
    offsets: wp.uint64,
    senders: wp.uint64,
    # in
    heard: wp.uint64,
    sent: wp.uint64,
    bias: wp.uint64,
    length: wp.uint64,
    weight: wp.uint64,
    # out
    out: wp.uint64,
) -> None:
    """Launch with dim 1; addresses of contiguous float32 (graph: int32) memory."""
    message_mean_rows(
        vertices, batch, hidden, kinds, offsets, senders, heard, sent, bias, length, weight, out
    )


@wp.kernel
def message_mean_adjoint(
    # sizes
    vertices: wp.int32,
    batch: wp.int32,
    hidden: wp.int32,
    kinds: wp.int32,
    # graph
    offsets: wp.uint64,
    senders: wp.uint64,
    # in
    heard: wp.uint64,
    sent: wp.uint64,
    bias: wp.uint64,
    length: wp.uint64,
    weight: wp.uint64,
    grad: wp.uint64,
    # out
    grad_heard: wp.uint64,
    grad_sent: wp.uint64,
    grad_bias: wp.uint64,
    grad_length: wp.uint64,
    grad_weight: wp.uint64,
) -> None:
    """Launch with dim 1; the outputs but ``grad_heard`` arrive zeroed."""
    message_mean_adjoint_rows(
        vertices,
        batch,
        hidden,
        kinds,
        offsets,
        senders,
        heard,
        sent,
        bias,
        length,
        weight,
        grad,
        grad_heard,
        grad_sent,
        grad_bias,
        grad_length,
        grad_weight,
    )
