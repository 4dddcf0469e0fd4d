"""Warp kernels of the message sum and its adjoint, in native rows of sixteen hidden channels.

    out[i, b, :] = Σ_e relu(heard[i, b, :] + sent[s_e, b, :] + bias[e, :] + length[e, b] · weight[k, :])

over the edges e of receiver i, which lie together; receivers come in groups of equal size, and k is the
group of i. Nothing of the size (edges, batch, hidden) is ever stored:
the adjoint computes the sums again. One thread walks all receivers, so the adjoint's scatter needs no
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
                *(V*)(O + row + c) = sum;
            }
            for (int c = whole; c < hidden; ++c) {
                float sum = 0.0f;
                for (int e = first[i]; e < first[i + 1]; ++e) {
                    const float m = P[row + c] + Q[(long long)(sender[e] * batch + b) * hidden + c]
                        + S[(long long)e * hidden + c] + R[e * batch + b] * W[c];
                    sum += m > 0.0f ? m : 0.0f;
                }
                O[row + c] = sum;
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
    for (int i = 0; i < vertices; ++i)
        for (int b = 0; b < batch; ++b) {
            const long long row = (long long)(i * batch + b) * hidden;
            const float* W = (const float*)weight + i / group * hidden;
            float* dW = (float*)grad_weight + i / group * hidden;
            for (int e = first[i]; e < first[i + 1]; ++e) {
                const long long q = (long long)(sender[e] * batch + b) * hidden;
                const long long s = (long long)e * hidden;
                const float r = R[e * batch + b];
                V along = 0.0f;
                float slope = 0.0f;
                for (int c = 0; c < whole; c += 16) {
                    const V w = *(const V*)(W + c);
                    const V m = *(const V*)(P + row + c) + *(const V*)(Q + q + c) + *(const V*)(S + s + c) +
                    r * w; const V g = (V)((I)(*(const V*)(G + row + c)) & (m > 0.0f));
                    *(V*)(dP + row + c) += g;
                    *(V*)(dQ + q + c) += g;
                    *(V*)(dS + s + c) += g;
                    *(V*)(dW + c) += r * g;
                    along += g * w;
                }
                for (int c = whole; c < hidden; ++c) {
                    const float m = P[row + c] + Q[q + c] + S[s + c] + r * W[c];
                    const float g = m > 0.0f ? G[row + c] : 0.0f;
                    dP[row + c] += g;
                    dQ[q + c] += g;
                    dS[s + c] += g;
                    dW[c] += r * g;
                    slope += g * W[c];
                }
                for (int k = 0; k < 16; ++k) slope += along[k];
                dR[e * batch + b] = slope;
            }
        }
"""
)


@wp.func_native(_FORWARD)
def message_sum_rows(
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
): ...


@wp.func_native(_ADJOINT)
def message_sum_adjoint_rows(
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
): ...


@wp.kernel
def message_sum(
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
):
    """Launch with dim 1; addresses of contiguous float32 (graph: int32) memory."""
    message_sum_rows(vertices, batch, hidden, kinds, offsets, senders, heard, sent, bias, length, weight, out)


@wp.kernel
def message_sum_adjoint(
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
):
    """Launch with dim 1; the outputs arrive zeroed."""
    message_sum_adjoint_rows(
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
