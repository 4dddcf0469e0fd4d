"""The grip's frame in the native rollout: C++ text of what enters and leaves it, in double precision.

Equations: ``physworld.worldmodel.model.frame``. ``framed`` of the engine's sizes: 0 world axes, 1 control vertices in a
plane or in space, 2 on a line. ``enter`` fills ``window`` (h+2, V, 3) from the path's frames t-h … t+1 (of the last one
only the control vertices are known); ``leave`` takes object vertices out of it again.
"""

from __future__ import annotations

from physworld.worldmodel.model.frame import NEWTON, OPPOSITE

FRAME = (
    r"""
    double turn[9], middle[3];
    auto cross = [](const double* a, const double* b, double* out) {
        out[0] = a[1] * b[2] - a[2] * b[1];
        out[1] = a[2] * b[0] - a[0] * b[2];
        out[2] = a[0] * b[1] - a[1] * b[0];
    };
    auto size_of = [](const double* a, int count) {
        double square = 0.0;
        for (int i = 0; i < count; ++i) square += a[i] * a[i];
        return __builtin_sqrt(square);
    };
    auto cofactors = [&](const double* m, double* out) {
        cross(m + 3, m + 6, out);
        cross(m + 6, m, out + 3);
        cross(m, m + 3, out + 6);
    };
    auto find_turn = [&](const float* controls) {  // R and the middle of control vertices (C, 3)
        double seen[9] = {0.0}, total = 0.0, other[9];
        for (int k = 0; k < 3; ++k) {
            middle[k] = 0.0;
            for (int c = 0; c < C; ++c) middle[k] += controls[c * 3 + k];
            middle[k] /= C;
        }
        for (int c = 0; c < C; ++c)
            for (int j = 0; j < 3; ++j) {
                const double own = frame_shape[c * 3 + j];
                total += own * own;
                for (int i = 0; i < 3; ++i) seen[3 * i + j] += (controls[c * 3 + i] - middle[i]) * own;
            }
        for (int i = 0; i < 9; ++i) seen[i] /= total;
        if (framed == 2) {
            double line[3], onto[3], k[3], lean = 1.0;
            for (int i = 0; i < 3; ++i) line[i] = frame_line[i];
            for (int i = 0; i < 3; ++i)
                onto[i] = seen[3 * i] * line[0] + seen[3 * i + 1] * line[1] + seen[3 * i + 2] * line[2];
            const double size = size_of(onto, 3);
            for (int i = 0; i < 3; ++i) {
                onto[i] /= size;
                lean += onto[i] * line[i];
            }
            cross(line, onto, k);
            if (lean < """
    + repr(OPPOSITE)
    + r""") lean = """
    + repr(OPPOSITE)
    + r""";
            const double square = k[0] * k[0] + k[1] * k[1] + k[2] * k[2];
            const double by[9] = {0.0, -k[2], k[1], k[2], 0.0, -k[0], -k[1], k[0], 0.0};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    turn[3 * i + j] = (i == j) + by[3 * i + j] + (k[i] * k[j] - (i == j) * square) / lean;
            return;
        }
        cofactors(seen, other);
        const double size = size_of(seen, 9);
        for (int i = 0; i < 9; ++i) turn[i] = seen[i] + other[i] / size;
        for (int round = 0; round < """
    + str(NEWTON)
    + r"""; ++round) {
            cofactors(turn, other);
            const double det = turn[0] * other[0] + turn[1] * other[1] + turn[2] * other[2];
            for (int i = 0; i < 9; ++i) other[i] /= det;
            const double scale = __builtin_sqrt(size_of(other, 9) / size_of(turn, 9));
            for (int i = 0; i < 9; ++i) turn[i] = 0.5 * (scale * turn[i] + other[i] / scale);
        }
    };
    auto enter = [&](const float* from) {
        find_turn(from + ((long long)(history + 1) * VN + N) * 3);
        for (int s = 0; s <= history + 1; ++s) {
            const double ticks = s - history;
            for (int i = s > history ? N : 0; i < VN; ++i) {
                const long long at = ((long long)s * VN + i) * 3;
                double x[3];
                for (int k = 0; k < 3; ++k) x[k] = from[at + k] - middle[k] - ticks * ticks * frame_fall[k];
                for (int j = 0; j < 3; ++j) window[at + j] = x[0] * turn[j] + x[1] * turn[3 + j] + x[2] * turn[6 + j];
            }
        }
    };
    auto leave = [&](const float* local, float* to) {
        for (int i = 0; i < N; ++i)
            for (int k = 0; k < 3; ++k) {
                double x = middle[k] + frame_fall[k];
                for (int j = 0; j < 3; ++j) x += turn[3 * k + j] * local[i * 3 + j];
                to[i * 3 + k] = x;
            }
    };
"""
)
