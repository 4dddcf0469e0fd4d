"""The native text of the chain prior, in rows of sixteen nodes: its flow over a tick, the flow's adjoint, a step.

Places are kept by component, three rows of nodes with room before and after them, so that neighbours along the chain
are loads at a shifted address. ``TEXT``, ``ADJOINT`` and ``STEP`` are lambdas over the names in ``CHAIN_SIZES`` and
``CHAIN_ARRAYS`` of ``chain_kernels``; ``STEP`` reads the frames of ``path`` beside. Working memory is
``chain_scratch``, rows of W: 0 to 23 of the flow and its adjoint, 24 to 59 of a step, 60 to 69 the moduli,
70 to 75 the push of the natural curvature and the directions across the segments.
"""

from __future__ import annotations

VECTORS = r"""
    typedef float V __attribute__((ext_vector_type(16), aligned(4)));
    typedef int I __attribute__((ext_vector_type(16), aligned(4)));
    auto fused = [](float a, V b, V c) -> V { return __builtin_elementwise_fma((V)a, b, c); };
"""

TEXT = r"""
    const int K = chain_nodes, P = chain_width, W = chain_width + 32, S = chain_substeps;
    auto row = [&](float* values, int axis) -> float* { return values + axis * W + 16; };
    auto at = [](const float* address) -> V { return *(const V*)address; };
    // out (nodes, 3) = [out +] matrix (given by columns) * in
    auto apply = [&](const float* columns, float* in, float* out, bool add) {
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < P; c += 16) {
                V sum = 0.0f;
                if (add) sum = at(row(out, a) + c);
                for (int k = 0; k < K; ++k) sum = fused(row(in, a)[k], at(columns + k * P + c), sum);
                *(V*)(row(out, a) + c) = sum;
            }
    };
    auto clear = [&](float* values) { for (int i = 0; i < 3 * W; ++i) values[i] = 0.0f; };
    // forces of stretch and bending on the nodes; ``size`` holds the lengths before and gets those now
    auto push = [&](float* place, float* size, const float* pull, const float* bend, float* force, float* f, float* m,
                    bool first) {
        for (int c = 0; c < P; c += 16) {
            V d[3], square = 1e-24f;
            for (int a = 0; a < 3; ++a) {
                d[a] = at(row(place, a) + c + 1) - at(row(place, a) + c);
                square += d[a] * d[a];
            }
            const V now = __builtin_elementwise_sqrt(square), per = 1.0f / now, k = at(pull + c);
            V tension = k - k * at(chain_length + c) * per;
            if (!first) tension += at(chain_dash + c) * (now - at(size + c)) * per;
            *(V*)(size + c) = now;
            for (int a = 0; a < 3; ++a) {
                *(V*)(row(f, a) + c) = tension * d[a];
                *(V*)(row(m, a) + c) = at(bend + c) * (at(chain_curve + c) * at(row(place, a) + c)
                    + at(chain_curve + P + c) * at(row(place, a) + c + 1)
                    + at(chain_curve + 2 * P + c) * at(row(place, a) + c + 2));
            }
        }
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < P; c += 16) {
                const float *F = row(f, a) + c, *M = row(m, a) + c;
                V sum = at(F) - at(F - 1) - at(chain_curve + c) * at(M);
                sum -= at(chain_curve + P + c - 1) * at(M - 1) + at(chain_curve + 2 * P + c - 2) * at(M - 2);
                *(V*)(row(force, a) + c) = sum;
            }
    };
    // one tick of the chain from ``place`` and ``velocity``, both changed; driven nodes go here + s slope + s^2/2 turn
    auto flow = [&](float* place, float* velocity, float* here, float* slope, float* turn, const float* pull,
                    const float* bend, const float* ease, float* steady, float* trace) {
        float* spare = chain_scratch;
        float *force = spare, *f = spare + 3 * W, *m = spare + 6 * W, *size = spare + 9 * W + 16;
        float* whole = spare + 12 * W;
        const float step = 1.0f / S;
        const int every = chain_calms ? S / chain_calms : S + 1;
        for (int s = 0; s < S; ++s) {
            if (trace) for (int i = 0; i < 3 * W; ++i) trace[(long long)s * 3 * W + i] = place[i];
            push(place, size, pull, bend, force, f, m, s == 0);
            const float now = step * (s + 1);
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < P; c += 16) {
                    V* v = (V*)(row(velocity, a) + c);
                    *v += step * ((at(row(force, a) + c) + at(row(steady, a) + c)) * at(ease + c)
                        + at(chain_free + c) * chain_gravity[a]);
                }
            if (s % every == every - 1) {
                for (int a = 0; a < 3; ++a)
                    for (int c = 0; c < P; c += 16)
                        *(V*)(row(whole, a) + c) = at(row(velocity, a) + c)
                            + (1.0f - at(chain_free + c)) * (at(row(slope, a) + c) + now * at(row(turn, a) + c));
                apply(chain_calm, whole, velocity, false);
                for (int a = 0; a < 3; ++a)
                    for (int c = 0; c < P; c += 16) *(V*)(row(velocity, a) + c) *= at(chain_free + c);
            }
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < P; c += 16) {
                    V* x = (V*)(row(place, a) + c);
                    const V led = at(row(here, a) + c)
                        + now * (at(row(slope, a) + c) + 0.5f * now * at(row(turn, a) + c));
                    *x = at(chain_free + c) * (*x + step * at(row(velocity, a) + c)) + led;
                }
        }
    };
"""

ADJOINT = r"""
    // gradients of a loss by the flow's start, velocity, pull, bend, ease and push from that by its end (in ``to``)
    auto unflow = [&](const float* trace, float* to, float* by_velocity, const float* pull, const float* bend,
                      const float* ease, float* steady, float* by_pull, float* by_bend, float* by_ease,
                      float* by_steady) {
        float* spare = chain_scratch;
        float *force = spare, *f = spare + 3 * W, *m = spare + 6 * W, *size = spare + 9 * W + 16;
        float* whole = spare + 12 * W;
        float *later = spare + 15 * W + 16, *held = spare + 18 * W, *older = spare + 21 * W + 16;
        const float step = 1.0f / S;
        const int every = chain_calms ? S / chain_calms : S + 1;
        for (int c = 0; c < P; c += 16) *(V*)(later + c) = (V)0.0f;
        for (int s = S - 1; s >= 0; --s) {
            for (int i = 0; i < 3 * W; ++i) held[i] = trace[(long long)s * 3 * W + i];
            if (s > 0) {
                float* was = (float*)trace + (long long)(s - 1) * 3 * W;
                for (int c = 0; c < P; c += 16) {
                    V square = 1e-24f;
                    for (int a = 0; a < 3; ++a) {
                        const V d = at(row(was, a) + c + 1) - at(row(was, a) + c);
                        square += d * d;
                    }
                    *(V*)(older + c) = __builtin_elementwise_sqrt(square);
                    *(V*)(size + c) = at(older + c);
                }
            }
            push(held, size, pull, bend, force, f, m, s == 0);
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < P; c += 16) {
                    V* x = (V*)(row(to, a) + c);
                    *x *= at(chain_free + c);
                    *(V*)(row(by_velocity, a) + c) += step * *x;
                }
            if (s % every == every - 1) {
                apply(chain_calm_back, by_velocity, whole, false);
                for (int a = 0; a < 3; ++a)
                    for (int c = 0; c < P; c += 16)
                        *(V*)(row(by_velocity, a) + c) = at(chain_free + c) * at(row(whole, a) + c);
            }
            // by the forces, in ``whole``
            for (int c = 0; c < P; c += 16) {
                V sum = 0.0f;
                for (int a = 0; a < 3; ++a) {
                    const V v = at(row(by_velocity, a) + c);
                    sum += v * (at(row(force, a) + c) + at(row(steady, a) + c));
                    *(V*)(row(whole, a) + c) = step * at(ease + c) * v;
                    *(V*)(row(by_steady, a) + c) += at(row(whole, a) + c);
                }
                *(V*)(by_ease + c) += step * sum;
            }
            for (int c = 0; c < P; c += 16) {
                V d[3], g[3], along = 0.0f, bent = 0.0f;
                for (int a = 0; a < 3; ++a) {
                    float *x = row(held, a) + c, *F = row(whole, a) + c;
                    d[a] = at(x + 1) - at(x);
                    g[a] = at(F) - at(F + 1);
                    along += g[a] * d[a];
                    const V by = -(at(chain_curve + c) * at(F) + at(chain_curve + P + c) * at(F + 1)
                        + at(chain_curve + 2 * P + c) * at(F + 2));
                    const V curved = at(chain_curve + c) * at(x) + at(chain_curve + P + c) * at(x + 1)
                        + at(chain_curve + 2 * P + c) * at(x + 2);
                    bent += by * curved;
                    *(V*)(row(m, a) + c) = at(bend + c) * by;
                }
                const V now = at(size + c), per = 1.0f / now, k = at(pull + c), rest = at(chain_length + c);
                *(V*)(by_bend + c) += bent;
                *(V*)(by_pull + c) += along * (1.0f - rest * per);
                V tension = k - k * rest * per, by_size = along * k * rest * per * per + at(later + c);
                if (s > 0) {
                    const V dash = at(chain_dash + c), then = at(older + c);
                    tension += dash * (now - then) * per;
                    by_size += along * dash * then * per * per;
                    *(V*)(later + c) = -along * dash * per;
                }
                for (int a = 0; a < 3; ++a) *(V*)(row(f, a) + c) = tension * g[a] + by_size * per * d[a];
            }
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < P; c += 16) {
                    const float *F = row(f, a) + c, *M = row(m, a) + c;
                    V sum = at(F - 1) - at(F) + at(chain_curve + c) * at(M);
                    sum += at(chain_curve + P + c - 1) * at(M - 1) + at(chain_curve + 2 * P + c - 2) * at(M - 2);
                    *(V*)(row(to, a) + c) += sum;
                }
        }
    };
"""

STEP = r"""
    auto crossed = [](const float* p, const float* q, float* r) {
        for (int a = 0; a < 3; ++a) r[a] = p[(a + 1) % 3] * q[(a + 2) % 3] - p[(a + 2) % 3] * q[(a + 1) % 3];
    };
    auto dot = [](const float* p, const float* q) -> float { return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]; };
    auto unit = [&](float* p) {
        const float per = 1.0f / __builtin_sqrtf(dot(p, p));
        for (int a = 0; a < 3; ++a) p[a] *= per;
    };
    // out = o turned by the least rotation, whose axis times sine is z and whose cosine is lean - 1
    auto least = [&](const float* z, float lean, const float* o, float* out) {
        float once[3], twice[3];
        if (lean < 1e-6f) lean = 1e-6f;
        crossed(z, o, once);
        crossed(z, once, twice);
        for (int a = 0; a < 3; ++a) out[a] = o[a] + once[a] + twice[a] / lean;
    };
    // a grip's middle (3), and what turns its frame: u, y, z (9) and 1 + the cosine of the least rotation, from control
    // vertices (C, 3)
    auto grip_of = [&](int g, const float* controls, float* centre, float* frame) -> float {
        float *u = frame, *y = frame + 3, *z = frame + 6, b[3] = {0, 0, 0};
        for (int a = 0; a < 3; ++a) centre[a] = u[a] = 0.0f;
        for (int c = 0; c < C; ++c)
            for (int a = 0; a < 3; ++a) {
                centre[a] += chain_anchor[g * C + c] * controls[c * 3 + a];
                u[a] += chain_first[g * C + c] * controls[c * 3 + a];
                b[a] += chain_second[g * C + c] * controls[c * 3 + a];
            }
        const int markers = (int)chain_markers[g];
        if (markers > 1) unit(u);
        if (markers == 2) {
            crossed(chain_axis + 3 * g, u, z);
            return 1.0f + dot(chain_axis + 3 * g, u);
        }
        if (markers > 2) {
            crossed(u, b, z);
            unit(z);
            crossed(z, u, y);
        }
        return 1.0f;
    };
    // out = o in the frame of grip g, in the world's axes
    auto turned_by = [&](int g, const float* frame, float lean, const float* o, float* out) {
        const int markers = (int)chain_markers[g];
        const float *u = frame, *y = frame + 3, *z = frame + 6;
        if (markers == 2) least(z, lean, o, out);
        for (int a = 0; a < 3 && markers != 2; ++a)
            out[a] = markers == 1 ? o[a] : o[0] * u[a] + o[1] * y[a] + o[2] * z[a];
    };
    // places of the driven nodes from control vertices (C, 3)
    auto driven = [&](const float* controls, float* out) {
        clear(out);
        for (int g = 0; g < chain_groups; ++g) {
            float centre[3], frame[9], turned[3];
            const float lean = grip_of(g, controls, centre, frame);
            for (int k = 0; k < K; ++k) {
                if (chain_member[k * chain_groups + g] == 0.0f) continue;
                turned_by(g, frame, lean, chain_offset + 3 * k, turned);
                for (int a = 0; a < 3; ++a) row(out, a)[k] = centre[a] + turned[a];
            }
        }
    };
    // force of the natural curvature on nodes at ``place``, with control vertices (C, 3) and ``bend``
    auto curving = [&](float* place, const float* controls, const float* bend, float* steady) {
        clear(steady);
        if (!chain_curved) return;
        float* across = chain_scratch + 73 * W;
        auto tangent = [&](int j, float* t) {
            for (int a = 0; a < 3; ++a) t[a] = row(place, a)[j + 1] - row(place, a)[j];
            unit(t);
        };
        auto fetch = [&](int j, float* d) { for (int a = 0; a < 3; ++a) d[a] = row(across, a)[j]; };
        auto store = [&](int j, const float* d) { for (int a = 0; a < 3; ++a) row(across, a)[j] = d[a]; };
        // the direction that end e's grip holds, across segment j
        auto held = [&](int e, int j, float* d) {
            float centre[3], frame[9], t[3];
            const int g = (int)chain_carry[2 * e + 1];
            const float lean = grip_of(g, controls, centre, frame);
            turned_by(g, frame, lean, chain_normal + 3 * e, d);
            tangent(j, t);
            const float along = dot(d, t);
            for (int a = 0; a < 3; ++a) d[a] -= along * t[a];
            unit(d);
        };
        // carry it from segment j to the one beside it
        auto onward = [&](int j, int next) {
            float t[3], s[3], z[3], d[3], out[3];
            tangent(j, t);
            tangent(next, s);
            crossed(t, s, z);
            fetch(j, d);
            least(z, 1.0f + dot(t, s), d, out);
            store(next, out);
        };
        const int from = (int)chain_carry[0], last = (int)chain_carry[2];
        float d[3], t[3], e[3];
        held(0, from, d);
        store(from, d);
        for (int j = from; j < K - 2; ++j) onward(j, j + 1);
        for (int j = from; j > 0; --j) onward(j, j - 1);
        if (chain_carry[1] != chain_carry[3]) {
            float end[3];
            held(1, last, end);
            tangent(last, t);
            fetch(last, d);
            crossed(t, d, e);
            float off = atan2f(dot(end, e), dot(end, d)) - chain_twist[0];
            off = atan2f(sinf(off), cosf(off));
            for (int j = 0; j < K - 1; ++j) {
                const float c = cosf(chain_between[j] * off), s = sinf(chain_between[j] * off);
                tangent(j, t);
                fetch(j, d);
                crossed(t, d, e);
                for (int a = 0; a < 3; ++a) row(across, a)[j] = c * d[a] + s * e[a];
            }
        }
        for (int i = 0; i < K - 2; ++i) {
            float one[3], two[3], s[3], f[3];
            fetch(i, d);
            tangent(i, t);
            crossed(t, d, e);
            fetch(i + 1, one);
            tangent(i + 1, s);
            crossed(s, one, two);
            for (int a = 0; a < 3; ++a) {
                f[a] = 0.5f * (chain_natural[2 * i] * (d[a] + one[a]) + chain_natural[2 * i + 1] * (e[a] + two[a]));
                for (int k = 0; k < 3; ++k) row(steady, a)[i + k] += chain_curve[k * P + i] * bend[i] * f[a];
            }
        }
    };
    // out = nodes of all vertices (V, 3), whose driven nodes are at ``led``
    auto read = [&](const float* vertices, float* led, float* out) {
        apply(chain_hold, led, out, false);
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < P; c += 16) {
                V sum = at(row(out, a) + c);
                for (int i = 0; i < N; ++i) sum = fused(vertices[i * 3 + a], at(chain_read + i * P + c), sum);
                *(V*)(row(out, a) + c) = sum;
            }
    };
    // take from ``change`` of ``place`` what lengthens the segments
    auto slacken = [&](float* place, float* change) {
        float *along = chain_scratch, *push_ = chain_scratch + 3 * W, *stretch = chain_scratch + 6 * W + 16;
        for (int c = 0; c < P; c += 16) {
            V d[3], square = 1e-24f, sum = 0.0f;
            for (int a = 0; a < 3; ++a) {
                d[a] = at(row(place, a) + c + 1) - at(row(place, a) + c);
                square += d[a] * d[a];
            }
            const V per = 1.0f / __builtin_elementwise_sqrt(square);
            for (int a = 0; a < 3; ++a) {
                *(V*)(row(along, a) + c) = d[a] * per;
                sum += d[a] * per * (at(row(change, a) + c + 1) - at(row(change, a) + c));
            }
            *(V*)(stretch + c) = sum;
        }
        for (int c = 0; c < P; c += 16) {
            V sum = 0.0f;
            for (int k = 0; k < K - 1; ++k) sum = fused(stretch[k], at(chain_slack + k * P + c), sum);
            for (int a = 0; a < 3; ++a) *(V*)(row(push_, a) + c) = sum * at(row(along, a) + c);
        }
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < P; c += 16)
                *(V*)(row(change, a) + c) -=
                    at(chain_lightness + c) * (at(row(push_, a) + c - 1) - at(row(push_, a) + c));
    };
    float* moduli = chain_scratch + 60 * W + 16;   // pull, bend, ease of this candidate
    // the candidate's moduli from its log ratios (N, 2)
    auto load = [&](const float* logs) {
        float *stiff = moduli + 3 * W, *pull = moduli, *bend = moduli + W, *ease = moduli + 2 * W;
        for (int k = 0; k < P; ++k) {
            float e = 0.0f, rho = 0.0f;
            for (int i = 0; i < N && k < K; ++i) {
                e += chain_share[k * N + i] * logs[2 * i];
                rho += chain_share[k * N + i] * logs[2 * i + 1];
            }
            auto within = [](float x, float most) -> float { return x > most ? most : (x < -most ? -most : x); };
            e = within(e, chain_reach[0]);
            rho = within(rho, chain_reach[1]);
            stiff[k] = e;
            ease[k] = chain_lightness[k] * __builtin_expf(-rho);
        }
        for (int k = 0; k < P; ++k) {
            pull[k] = k < K - 1 ? chain_pull[k] * __builtin_expf(0.5f * (stiff[k] + stiff[k + 1])) : 0.0f;
            bend[k] = k < K - 2 ? chain_bend[k] * __builtin_expf(stiff[k + 1]) : 0.0f;
        }
    };
    // where the object vertices of frame t + 1 will be, (N, 3) into ``out``
    auto chain = [&](int t, float* out) {
        float* work = chain_scratch + 24 * W;
        float *ahead = work, *here = work + 3 * W, *behind = work + 6 * W, *now = work + 9 * W, *was = work + 12 * W;
        float *speed = work + 15 * W, *slope = work + 18 * W, *turn = work + 21 * W, *one = work + 24 * W;
        float *two = work + 27 * W, *spare = work + 30 * W, *moved = work + 33 * W;
        const float* frame = path + (long long)t * VN * 3;
        driven(frame + VN * 3 + N * 3, ahead);
        driven(frame + N * 3, here);
        driven(frame - VN * 3 + N * 3, behind);
        read(frame, here, now);
        read(frame - VN * 3, behind, was);
        for (int i = 0; i < 3 * W; ++i) spare[i] = now[i] - was[i];
        if (chain_lags > 2) {
            driven(frame - 2 * VN * 3 + N * 3, one);
            read(frame - 2 * VN * 3, one, two);
            for (int i = 0; i < 3 * W; ++i) spare[i] = 1.5f * spare[i] - 0.5f * (was[i] - two[i]);
        }
        clear(speed);
        apply(chain_smooth, spare, speed, false);
        slacken(now, speed);
        clear(moved);
        float* steady = chain_scratch + 70 * W;
        curving(now, frame + N * 3, moduli + W, steady);
        for (int way = 0; way < 2; ++way) {
            const float sign = way ? -1.0f : 1.0f;
            for (int i = 0; i < 3 * W; ++i) {
                slope[i] = 0.5f * sign * (ahead[i] - behind[i]);
                turn[i] = ahead[i] - 2.0f * here[i] + behind[i];
                one[i] = now[i];
            }
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < P; c += 16)
                    *(V*)(row(two, a) + c) = sign * at(chain_free + c) * at(row(speed, a) + c);
            flow(one, two, here, slope, turn, moduli, moduli + W, moduli + 2 * W, steady, nullptr);
            for (int i = 0; i < 3 * W; ++i) moved[i] += 0.5f * one[i];
        }
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < P; c += 16) {
                const V past = at(chain_free + c) * at(row(was, a) + c) + at(row(behind, a) + c);
                *(V*)(row(spare, a) + c) = at(row(moved, a) + c) - past;
            }
        slacken(moved, spare);
        apply(chain_keep, spare, moved, true);
        for (int i = 0; i < N; ++i)
            for (int a = 0; a < 3; ++a) {
                V sum = 0.0f;
                for (int c = 0; c < P; c += 16) sum += at(chain_spread + i * P + c) * at(row(moved, a) + c);
                float total = 0.0f;
                for (int k = 0; k < 16; ++k) total += sum[k];
                out[i * 3 + a] = total;
            }
    };
"""
