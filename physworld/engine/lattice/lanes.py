"""C++ preambles of the native kernels: one vector type V whose lanes are a cell's particles.

On a CPU a vector is one SIMD register (GCC vector extension, which Warp's compiler understands); on CUDA it is a
scalar, the lanes become a loop, and nodal sums are atomic. The bodies of the kernels are the same text in both.

The struct ``lane`` has the functions of V. The struct ``D`` is a dual number over V, value ``a`` and derivative ``b``
in one direction: text that is written over a type S gives a value with S = V and a directional derivative with S = D.
A struct inside a function has no operators but members, so a D stands on the left of a product with a V or a float.
"""

from __future__ import annotations

_FLOAT8 = r"""
#if defined(__CUDA_ARCH__)
    typedef float V;
    const int LANES = 1;
    #define PW_INLINE __device__
    #define PW_ADD(address, value) atomicAdd(&(address), (double)(value))
#else
    typedef float V __attribute__((vector_size(32)));
    const int LANES = 8;
    #define PW_INLINE __attribute__((always_inline))
    #define PW_ADD(address, value) (address) += (double)(value)
#endif
"""

_DUAL = r"""
    struct D {
        V a, b;
        PW_INLINE D operator+(const D& o) const { return D{a + o.a, b + o.b}; }
        PW_INLINE D operator-(const D& o) const { return D{a - o.a, b - o.b}; }
        PW_INLINE D operator*(const D& o) const { return D{a * o.a, a * o.b + b * o.a}; }
        PW_INLINE D operator+(V o) const { return D{a + o, b}; }
        PW_INLINE D operator-(V o) const { return D{a - o, b}; }
        PW_INLINE D operator*(V o) const { return D{a * o, b * o}; }
#if !defined(__CUDA_ARCH__)
        PW_INLINE D operator+(NUMBER o) const { return D{a + o, b}; }
        PW_INLINE D operator-(NUMBER o) const { return D{a - o, b}; }
        PW_INLINE D operator*(NUMBER o) const { return D{a * o, b * o}; }
#endif
    };
"""

_FLOAT_FUNCTIONS = r"""
    struct lane {
#if defined(__CUDA_ARCH__)
        static PW_INLINE float sum(V v) { return v; }
        static PW_INLINE V log(V v) { return ::logf(v); }
        static PW_INLINE V sqrt(V v) { return ::sqrtf(v); }
        static PW_INLINE V absolute(V v) { return ::fabsf(v); }
        static PW_INLINE V floor(V v, float limit) { return ::fmaxf(v, limit); }
        static PW_INLINE V where_positive(V test, V v, V other) { return test > 0.0f ? v : other; }
        static PW_INLINE bool any_below(V v, float limit) { return !(v >= limit); }
#else
        typedef float H __attribute__((vector_size(16)));
        typedef int I __attribute__((vector_size(32)));
        static PW_INLINE float sum(V v) {
            H h = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
            h = h + __builtin_shufflevector(h, h, 2, 3, 0, 1);
            return h[0] + h[1];
        }
        static PW_INLINE V log(V v) {
            // Cephes logf: exponent and mantissa by bits, then a polynomial; relative error below 2e-7.
            I bits = (I)v;
            I e = ((bits >> 23) & 255) - 126;
            V m = (V)((bits & 0x007fffff) | 0x3f000000);
            I low = m < 0.70710678f;
            e = e + low;
            m = m + (V)((I)m & low) - 1.0f;
            V z = m * m;
            V y = m * (m * (m * (m * (m * (m * (m * (m * (m * 7.0376836292e-2f - 1.1514610310e-1f)
                  + 1.1676998740e-1f) - 1.2420140846e-1f) + 1.4249322787e-1f) - 1.6668057665e-1f)
                  + 2.0000714765e-1f) - 2.4999993993e-1f) + 3.3333331174e-1f) * z;
            V ef = __builtin_convertvector(e, V);
            return m + (y - 0.5f * z - 2.12194440e-4f * ef) + 0.693359375f * ef;
        }
        static PW_INLINE V sqrt(V v) { return __builtin_elementwise_sqrt(v); }
        static PW_INLINE V absolute(V v) { return (V)((I)v & 0x7fffffff); }
        static PW_INLINE V where_positive(V test, V v, V other) {
            I mask = test > 0.0f;
            return (V)(((I)v & mask) | ((I)other & ~mask));
        }
        static PW_INLINE V floor(V v, float limit) { return where_positive(v - limit, v, V{} + limit); }
        static PW_INLINE bool any_below(V v, float limit) {
            bool hit = false;
            for (int k = 0; k < 8; ++k) hit = hit || !(v[k] >= limit);
            return hit;
        }
#endif
        static PW_INLINE V value(V v) { return v; }
        static PW_INLINE V inverse(V v) { return 1.0f / v; }
        static PW_INLINE V value(const D& v) { return v.a; }
        static PW_INLINE D inverse(const D& v) {
            const V r = 1.0f / v.a;
            return D{r, v.b * r * r * -1.0f};
        }
        static PW_INLINE D log(const D& v) { return D{log(v.a), v.b / v.a}; }
        static PW_INLINE D sqrt(const D& v) {
            const V r = sqrt(v.a);
            return D{r, v.b * 0.5f / r};
        }
        static PW_INLINE D floor(const D& v, float limit) {
            return D{floor(v.a, limit), where_positive(v.a - limit, v.b, V{})};
        }
        static PW_INLINE D where_positive(V test, const D& v, V other) {
            return D{where_positive(test, v.a, other), where_positive(test, v.b, V{})};
        }
        // HELPERS
    };
"""


def lanes_float8(helpers: str = "") -> str:
    """Preamble for 8 particles in single precision: V, D, lane, LANES, PW_ADD; ``helpers`` become members of lane."""
    return _FLOAT8 + _DUAL.replace("NUMBER", "float") + _FLOAT_FUNCTIONS.replace("// HELPERS", helpers)


def lanes_double(lanes: int) -> str:
    """Preamble for ``lanes`` (2 or 4) particles in double precision: V, D, lane, LANES, PW_ADD."""
    total = " + ".join(f"v[{k}]" for k in range(lanes))
    return f"""
#if defined(__CUDA_ARCH__)
    typedef double V;
    const int LANES = 1;
    #define PW_INLINE __device__
    #define PW_ADD(address, value) atomicAdd(&(address), (value))
#else
    typedef double V __attribute__((vector_size({8 * lanes})));
    const int LANES = {lanes};
    #define PW_INLINE __attribute__((always_inline))
    #define PW_ADD(address, value) (address) += (value)
#endif
{_DUAL.replace("NUMBER", "double")}
    struct lane {{
#if defined(__CUDA_ARCH__)
        static PW_INLINE double sum(V v) {{ return v; }}
        static PW_INLINE V sqrt(V v) {{ return ::sqrt(v); }}
#else
        static PW_INLINE double sum(V v) {{ return {total}; }}
        static PW_INLINE V sqrt(V v) {{ return __builtin_elementwise_sqrt(v); }}
#endif
        static PW_INLINE V inverse(V v) {{ return 1.0 / v; }}
        static PW_INLINE D inverse(const D& v) {{
            const V r = 1.0 / v.a;
            return D{{r, v.b * r * r * -1.0}};
        }}
        static PW_INLINE D sqrt(const D& v) {{
            const V r = sqrt(v.a);
            return D{{r, v.b * 0.5 / r}};
        }}
    }};
"""
