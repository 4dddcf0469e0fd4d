"""The native search for the nearest vertices: all pairs, for graphs of a hundred or a few hundred vertices.

At 146 vertices all pairs are 21,000 distances, little beside the network's products; a table of cells would pay for
thousands of vertices. ``NEAREST`` is a lambda that the rollout engine (``engine_kernels``) holds too: the same places
give the same neighbours in training and in a rollout. CPU only.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

NEAREST = r"""
    // senders (n, most) ascending and found (n) of places (n, 3); reach (most) is working memory
    auto find_nearest = [](const float* place, int n, int most, float radius, int* senders, int* found, float* reach) {
        const float square = radius * radius;
        for (int i = 0; i < n; ++i) {
            int* mine = senders + (long long)i * most;
            int kept = 0;
            float last = square;
            for (int from = 0; from < n; from += 64) {
                float distance[64];
                const int count = from + 64 < n ? 64 : n - from;
                const float* other = place + 3 * from;
                for (int j = 0; j < count; ++j) {
                    const float x = other[3 * j] - place[3 * i], y = other[3 * j + 1] - place[3 * i + 1],
                                z = other[3 * j + 2] - place[3 * i + 2];
                    distance[j] = x * x + y * y + z * z;
                }
                for (int j = 0; j < count; ++j) {
                    const float d = distance[j];
                    if (kept < most ? !(d <= square) : !(d < last)) continue;
                    if (from + j == i) continue;
                    int at = kept < most ? kept++ : most - 1;
                    for (; at > 0 && reach[at - 1] > d; --at) {
                        reach[at] = reach[at - 1];
                        mine[at] = mine[at - 1];
                    }
                    reach[at] = d;
                    mine[at] = from + j;
                    last = reach[most - 1];
                }
            }
            for (int a = 1; a < kept; ++a) {
                const int one = mine[a];
                int at = a;
                for (; at > 0 && mine[at - 1] > one; --at) mine[at] = mine[at - 1];
                mine[at] = one;
            }
            found[i] = kept;
        }
    };
"""

_SEARCH = (
    NEAREST
    + r"""
    for (int b = 0; b < batch; ++b)
        find_nearest((const float*)places + (long long)b * n * 3, n, most, radius,
                     (int*)senders + (long long)b * n * most, (int*)found + (long long)b * n, (float*)reach);
"""
)


@wp.func_native(_SEARCH)
def nearest_rows(
    batch: wp.int32,
    n: wp.int32,
    most: wp.int32,
    radius: wp.float32,
    places: wp.uint64,
    senders: wp.uint64,
    found: wp.uint64,
    reach: wp.uint64,
): ...


@wp.kernel
def nearest(
    batch: wp.int32,
    n: wp.int32,
    most: wp.int32,
    radius: wp.float32,
    places: wp.uint64,
    senders: wp.uint64,
    found: wp.uint64,
    reach: wp.uint64,
):
    """Launch with dim 1; addresses of contiguous float32 and int32 memory."""
    nearest_rows(batch, n, most, radius, places, senders, found, reach)
