"""C++ preambles of the native kernels: one vector type V whose lanes are a cell's particles.

On a CPU a vector is one SIMD register (GCC vector extension, which Warp's compiler understands); on CUDA it is a
scalar, the lanes become a loop, and nodal sums are atomic. The bodies of the kernels are the same text in both.
"""

from __future__ import annotations

LANES_FLOAT8 = r"""
#if defined(__CUDA_ARCH__)
    typedef float V;
    const int LANES = 1;
    #define PW_ADD(address, value) atomicAdd(&(address), (double)(value))
    #define PW_SUM(v) (v)
    #define PW_LOG(v) logf(v)
    #define PW_ANY_BELOW(v, limit) ((v) < (limit))
    #define PW_FLOOR(v, limit) fmaxf((v), (limit))
    #define PW_WHERE_POSITIVE(test, v, other) ((test) > 0.0f ? (v) : (other))
#else
    typedef float V __attribute__((vector_size(32)));
    typedef float H __attribute__((vector_size(16)));
    typedef int I __attribute__((vector_size(32)));
    const int LANES = 8;
    #define PW_ADD(address, value) (address) += (double)(value)
    auto sum_lanes = [](V v) -> float {
        H h = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
        h = h + __builtin_shufflevector(h, h, 2, 3, 0, 1);
        return h[0] + h[1];
    };
    auto log_lanes = [](V v) -> V {
        // Cephes logf: exponent and mantissa by bits, then a polynomial; relative error below 2e-7.
        I bits = (I)v;
        I e = ((bits >> 23) & 255) - 126;
        V m = (V)((bits & 0x007fffff) | 0x3f000000);
        I low = m < 0.70710678f;
        e = e + low;
        m = m + (V)((I)m & low) - 1.0f;
        V z = m * m;
        V y = m * (m * (m * (m * (m * (m * (m * (m * (m * 7.0376836292e-2f - 1.1514610310e-1f) + 1.1676998740e-1f)
              - 1.2420140846e-1f) + 1.4249322787e-1f) - 1.6668057665e-1f) + 2.0000714765e-1f) - 2.4999993993e-1f)
              + 3.3333331174e-1f) * z;
        V ef = __builtin_convertvector(e, V);
        return m + (y - 0.5f * z - 2.12194440e-4f * ef) + 0.693359375f * ef;
    };
    auto any_below = [](V v, float limit) -> bool {
        bool hit = false;
        for (int k = 0; k < 8; ++k) hit = hit || !(v[k] >= limit);
        return hit;
    };
    auto floor_lanes = [](V v, float limit) -> V {
        I low = v < limit;
        return (V)(((I)v & ~low) | ((I)(V{} + limit) & low));
    };
    #define PW_SUM(v) sum_lanes(v)
    #define PW_LOG(v) log_lanes(v)
    #define PW_ANY_BELOW(v, limit) any_below((v), (limit))
    auto where_positive = [](V test, V v, float other) -> V {
        I filled = test > 0.0f;
        return (V)(((I)v & filled) | ((I)(V{} + other) & ~filled));
    };
    #define PW_FLOOR(v, limit) floor_lanes((v), (limit))
    #define PW_WHERE_POSITIVE(test, v, other) where_positive((test), (v), (other))
#endif
"""


def lanes_double(lanes: int) -> str:
    """Preamble for ``lanes`` (2 or 4) particles in double precision: V, LANES, PW_ADD, PW_SUM, PW_SQRT."""
    total = " + ".join(f"v[{k}]" for k in range(lanes))
    roots = ", ".join(f"sqrt(v[{k}])" for k in range(lanes))
    return f"""
#if defined(__CUDA_ARCH__)
    typedef double V;
    const int LANES = 1;
    #define PW_ADD(address, value) atomicAdd(&(address), (value))
    #define PW_SUM(v) (v)
    #define PW_SQRT(v) sqrt(v)
#else
    typedef double V __attribute__((vector_size({8 * lanes})));
    const int LANES = {lanes};
    auto sum_lanes = [](V v) -> double {{ return {total}; }};
    auto sqrt_lanes = [](V v) -> V {{ return V{{{roots}}}; }};
    #define PW_ADD(address, value) (address) += (value)
    #define PW_SUM(v) sum_lanes(v)
    #define PW_SQRT(v) sqrt_lanes(v)
#endif
"""
