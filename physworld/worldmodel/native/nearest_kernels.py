"""The native search for the nearest vertices: all pairs, for graphs of a hundred or a few hundred vertices.

At 146 vertices all pairs are 21,000 distances, little beside the network's products; a table of cells would pay for
thousands of vertices. ``NEAREST`` is a lambda that the rollout engine (``engine_kernels``) holds too: the same places
give the same neighbours in training and in a rollout. CPU only.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

NEAREST = r"""
    // senders (n, most) ascending and found (n) of places (n, 3); room (most + 3 n) is working memory. What senders and
    // found hold on entry bounds the search: no k-th neighbour is farther than the farthest of any k.
    auto find_nearest = [](const float* place, int n, int most, float radius, int* senders, int* found, float* room) {
        const float square = radius * radius;
        float *reach = room, *xs = room + most, *ys = xs + n, *zs = ys + n;
        for (int i = 0; i < n; ++i) {
            xs[i] = place[3 * i];
            ys[i] = place[3 * i + 1];
            zs[i] = place[3 * i + 2];
        }
        for (int i = 0; i < n; ++i) {
            int* mine = senders + (long long)i * most;
            auto apart = [&](int j) -> float {
                const float x = xs[j] - xs[i], y = ys[j] - ys[i], z = zs[j] - zs[i];
                return x * x + y * y + z * z;
            };
            float limit = square;
            if (found[i] == most) {
                float farthest = 0.0f;
                bool within = true;  // not where a place is not finite
                for (int a = 0; a < most; ++a) {
                    const float d = apart(mine[a]);
                    within = within && d <= square;
                    farthest = d > farthest ? d : farthest;
                }
                const float bound = farthest * 1.000001f;  // rounding: the loop below may fuse its products
                if (within && bound < square) limit = bound;
            }
            int kept = 0;
            float last = limit;
            for (int from = 0; from < n; from += 64) {
                float distance[64];
                int likely[64], many = 0;
                const int count = from + 64 < n ? 64 : n - from;
                for (int j = 0; j < count; ++j) distance[j] = apart(from + j);
                for (int j = 0; j < count; ++j) {
                    likely[many] = j;
                    many += distance[j] <= limit;
                }
                for (int a = 0; a < many; ++a) {
                    const int j = likely[a];
                    const float d = distance[j];
                    if ((kept == most && !(d < last)) || from + j == i) continue;
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
                     (int*)senders + (long long)b * n * most, (int*)found + (long long)b * n, (float*)room);
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
    room: wp.uint64,
) -> None: ...


@wp.kernel
def nearest(
    batch: wp.int32,
    n: wp.int32,
    most: wp.int32,
    radius: wp.float32,
    places: wp.uint64,
    senders: wp.uint64,
    found: wp.uint64,
    room: wp.uint64,
) -> None:
    """Launch with dim 1; addresses of contiguous float32 and int32 memory."""
    nearest_rows(batch, n, most, radius, places, senders, found, room)
