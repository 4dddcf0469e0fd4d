// MLS-MPM with APIC and quadratic B-splines, written by hand for one thread: what a CPU gives where nothing is general.
//
// One vec4 a node (momentum and mass, then velocity), rows of nodes along z, no branches in the loops, float32. The same
// step as the Taichi peer of benchmarks/mpm.py: neo-Hookean Kirchhoff stress mu (F F^T - I) + lambda ln(J) I.

#include <cmath>
#include <cstring>
#include <vector>

typedef float V4 __attribute__((vector_size(16)));

struct Particle {
    float x[3], volume;
    float v[3], pad;
    float C[9];
    float F[9];
};

static inline void weights(const float* x, float inv_dx, int* base, float fx[3], float w[3][3]) {
    for (int a = 0; a < 3; ++a) {
        const float scaled = x[a] * inv_dx;
        base[a] = (int)(scaled - 0.5f);
        const float f = scaled - (float)base[a];
        fx[a] = f;
        w[a][0] = 0.5f * (1.5f - f) * (1.5f - f);
        w[a][1] = 0.75f - (f - 1.0f) * (f - 1.0f);
        w[a][2] = 0.5f * (f - 0.5f) * (f - 0.5f);
    }
}

static inline V4 all(float value) { return V4{value, value, value, value}; }

extern "C" void run(int count, int grid, float dx, float dt, float mu, float lam, float density, int substeps,
                    float* x, float* v, float* C, float* F, const float* volume) {
    std::vector<Particle> particles(count);
    for (int p = 0; p < count; ++p) {
        Particle& q = particles[p];
        std::memcpy(q.x, x + 3 * p, sizeof q.x);
        std::memcpy(q.v, v + 3 * p, sizeof q.v);
        std::memcpy(q.C, C + 9 * p, sizeof q.C);
        std::memcpy(q.F, F + 9 * p, sizeof q.F);
        q.volume = volume[p];
    }
    const float inv_dx = 1.0f / dx;
    const int row = grid, plane = grid * grid;
    std::vector<V4> nodes((size_t)grid * grid * grid);
    for (int step = 0; step < substeps; ++step) {
        std::memset((void*)nodes.data(), 0, nodes.size() * sizeof(V4));
        for (Particle& p : particles) {
            int base[3];
            float fx[3], w[3][3], G[9], T[9];
            weights(p.x, inv_dx, base, fx, w);
            for (int i = 0; i < 9; ++i) G[i] = dt * p.C[i];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    T[3 * i + j] = p.F[3 * i + j] + G[3 * i] * p.F[j] + G[3 * i + 1] * p.F[3 + j] + G[3 * i + 2] * p.F[6 + j];
            std::memcpy(p.F, T, sizeof T);
            const float* f = p.F;
            const float J = f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) +
                            f[2] * (f[3] * f[7] - f[4] * f[6]);
            const float pressure = lam * std::log(J) - mu;
            const float mass = density * p.volume, scale = -dt * 4.0f * inv_dx * inv_dx * p.volume;
            V4 column[3];  // of the affine momentum, times dx
            for (int j = 0; j < 3; ++j) {
                float entry[3];
                for (int i = 0; i < 3; ++i) {
                    const float b = f[3 * i] * f[3 * j] + f[3 * i + 1] * f[3 * j + 1] + f[3 * i + 2] * f[3 * j + 2];
                    entry[i] = dx * (scale * (mu * b + (i == j ? pressure : 0.0f)) + mass * p.C[3 * i + j]);
                }
                column[j] = V4{entry[0], entry[1], entry[2], 0.0f};
            }
            const V4 own = V4{mass * p.v[0], mass * p.v[1], mass * p.v[2], mass};
            const V4 corner = own - column[0] * all(fx[0]) - column[1] * all(fx[1]) - column[2] * all(fx[2]);
            V4* first = &nodes[base[0] * plane + base[1] * row + base[2]];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    V4* node = first + i * plane + j * row;
                    const V4 start = corner + column[0] * all((float)i) + column[1] * all((float)j);
                    const float wij = w[0][i] * w[1][j];
                    node[0] += all(wij * w[2][0]) * start;
                    node[1] += all(wij * w[2][1]) * (start + column[2]);
                    node[2] += all(wij * w[2][2]) * (start + column[2] + column[2]);
                }
        }
        for (V4& node : nodes)
            if (node[3] > 0.0f) node /= all(node[3]);
        for (Particle& p : particles) {
            int base[3];
            float fx[3], w[3][3];
            weights(p.x, inv_dx, base, fx, w);
            const V4* first = &nodes[base[0] * plane + base[1] * row + base[2]];
            V4 sum = {}, moment[3] = {};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    const V4* node = first + i * plane + j * row;
                    const V4 a = all(w[2][0]) * node[0], b = all(w[2][1]) * node[1], c = all(w[2][2]) * node[2];
                    const V4 wij = all(w[0][i] * w[1][j]);
                    const V4 line = wij * (a + b + c);
                    sum += line;
                    moment[0] += line * all((float)i - fx[0]);
                    moment[1] += line * all((float)j - fx[1]);
                    moment[2] += wij * (b + c + c);
                }
            moment[2] -= sum * all(fx[2]);
            for (int i = 0; i < 3; ++i) {
                for (int j = 0; j < 3; ++j) p.C[3 * i + j] = 4.0f * inv_dx * moment[j][i];
                p.v[i] = sum[i];
                p.x[i] += dt * sum[i];
            }
        }
    }
    for (int p = 0; p < count; ++p) {
        const Particle& q = particles[p];
        std::memcpy(x + 3 * p, q.x, sizeof q.x);
        std::memcpy(v + 3 * p, q.v, sizeof q.v);
        std::memcpy(C + 9 * p, q.C, sizeof q.C);
        std::memcpy(F + 9 * p, q.F, sizeof q.F);
    }
}
