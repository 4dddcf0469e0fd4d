"""Warp kernels of the renderer: each pixel front to back over the Gaussians of its tile.

``blend`` takes a thread a pixel, for CUDA; ``blend_rows`` a thread a row of pixels of a tile, for the processor, whose
vector instructions work on all of them at once. Their pictures are the same but for rounding.
"""

from __future__ import annotations

import math

import warp as wp

TILE = 8
_LEAST_ALPHA = 1.0 / 255.0
_LEAST_POWER = math.log(_LEAST_ALPHA) - 1e-3  # below it no opacity shows, and the exponential is spared
_MOST_ALPHA = 0.99
_LEAST_LEFT = 1e-4
_SLACK = 1e-5  # of the terms whose difference says where a Gaussian ends


@wp.kernel(enable_backward=False)
def blend(
    width: int,
    tiles_across: int,
    starts: wp.array[wp.int32],
    order: wp.array[wp.int32],
    centres: wp.array[wp.vec2f],
    conics: wp.array[wp.vec3f],
    opacities: wp.array[wp.float32],
    colours: wp.array[wp.vec3f],
    depths: wp.array[wp.float32],
    background: wp.vec3f,
    picture: wp.array[wp.vec3f],
    alpha: wp.array[wp.float32],
    depth: wp.array[wp.float32],
) -> None:
    pixel = wp.tid()
    row = pixel // width
    column = pixel - row * width
    tile = (row // wp.static(TILE)) * tiles_across + column // wp.static(TILE)
    x = float(column) + 0.5
    y = float(row) + 0.5
    left = wp.float32(1.0)
    seen = wp.vec3f(0.0, 0.0, 0.0)
    far = wp.float32(0.0)
    for k in range(starts[tile], starts[tile + 1]):
        g = order[k]
        centre = centres[g]
        conic = conics[g]
        dx = x - centre[0]
        dy = y - centre[1]
        power = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy
        if power <= 0.0 and power >= wp.static(_LEAST_POWER):
            a = wp.min(wp.static(_MOST_ALPHA), opacities[g] * wp.exp(power))
            if a >= wp.static(_LEAST_ALPHA):
                after = left * (1.0 - a)
                if after < wp.static(_LEAST_LEFT):
                    break
                seen += left * a * colours[g]
                far += left * a * depths[g]
                left = after
    picture[pixel] = seen + left * background
    alpha[pixel] = 1.0 - left
    depth[pixel] = far


@wp.func_native(
    f"""
    const int most = {TILE};
    float left[most], hidden[most], red[most], green[most], blue[most], far[most];
    for (int i = 0; i < most; ++i) {{
        left[i] = 1.0f;
        hidden[i] = red[i] = green[i] = blue[i] = far[i] = 0.0f;
    }}
    const float y = (float)row + 0.5f;
    for (int k = nearest; k < behind; ++k) {{
        const int g = order.data[k];
        const float xx = conics.data[g][0], xy = conics.data[g][1], yy = conics.data[g][2];
        const float dy = y - centres.data[g][1];
        const float mixed = xy * dy, square = yy * dy * dy;
        // no pixel of the row has a power of the least: xx dx^2 + 2 mixed dx + square + 2 least > 0 for every dx
        const float ends = mixed * mixed - xx * (square + 2.0f * {_LEAST_POWER}f);
        if (ends + {_SLACK}f * (mixed * mixed + xx * square) <= 0.0f)
            continue;
        const float shift = (float)begin + 0.5f - centres.data[g][0];
        const float opacity = opacities.data[g], away = depths.data[g];
        const float r = colours.data[g][0], gr = colours.data[g][1], b = colours.data[g][2];
        for (int i = 0; i < most; ++i) {{
            const float dx = shift + (float)i;
            const float power = -0.5f * (xx * dx * dx + square) - mixed * dx;
            // e^power: 2^(whole + part), the part's by a polynomial (Moshier, Cephes)
            const float held = power < -6.0f ? -6.0f : (power > 0.0f ? 0.0f : power);
            const float binary = held * 1.44269504f;
            const int whole = (int)(binary - 0.5f);
            const float part = binary - (float)whole;
            float curve = 1.535336188319500e-4f;
            curve = curve * part + 1.339887440266574e-3f;
            curve = curve * part + 9.618437357674640e-3f;
            curve = curve * part + 5.550332471162809e-2f;
            curve = curve * part + 2.402264791363012e-1f;
            curve = curve * part + 6.931472028550421e-1f;
            union {{ int bits; float number; }} scale;
            scale.bits = (whole + 127) << 23;
            const float raw = opacity * (1.0f + part * curve) * scale.number;
            const float a = raw < {_MOST_ALPHA}f ? raw : {_MOST_ALPHA}f;
            const float after = left[i] * (1.0f - a);
            const int shows = (power <= 0.0f) & (power >= {_LEAST_POWER}f) & (a >= {_LEAST_ALPHA}f);
            const int last = shows & (after < {_LEAST_LEFT}f);
            const float weight = (shows & !last) ? left[i] * a : 0.0f;
            hidden[i] += last ? left[i] : 0.0f;
            left[i] = last ? 0.0f : (shows ? after : left[i]);
            red[i] += weight * r;
            green[i] += weight * gr;
            blue[i] += weight * b;
            far[i] += weight * away;
        }}
        float most_left = 0.0f;
        for (int i = 0; i < most; ++i)
            most_left = left[i] > most_left ? left[i] : most_left;
        if (most_left == 0.0f)
            break;
    }}
    for (int i = 0; i < count; ++i) {{
        const int pixel = first + i;
        const float rest = left[i] + hidden[i];
        picture.data[pixel] = wp::vec_t<3, wp::float32>(red[i], green[i], blue[i]) + background * rest;
        alpha.data[pixel] = 1.0f - rest;
        depth.data[pixel] = far[i];
    }}
    """
)
def _blend_row(
    row: int,
    begin: int,
    count: int,
    first: int,
    nearest: int,
    behind: int,
    order: wp.array[wp.int32],
    centres: wp.array[wp.vec2f],
    conics: wp.array[wp.vec3f],
    opacities: wp.array[wp.float32],
    colours: wp.array[wp.vec3f],
    depths: wp.array[wp.float32],
    background: wp.vec3f,
    picture: wp.array[wp.vec3f],
    alpha: wp.array[wp.float32],
    depth: wp.array[wp.float32],
) -> None:
    """Blend ``count`` pixels of a row from column ``begin`` on, of which ``first`` is the first one's number."""


@wp.kernel(enable_backward=False)
def blend_rows(
    first: int,
    width: int,
    tiles_across: int,
    starts: wp.array[wp.int32],
    order: wp.array[wp.int32],
    centres: wp.array[wp.vec2f],
    conics: wp.array[wp.vec3f],
    opacities: wp.array[wp.float32],
    colours: wp.array[wp.vec3f],
    depths: wp.array[wp.float32],
    background: wp.vec3f,
    picture: wp.array[wp.vec3f],
    alpha: wp.array[wp.float32],
    depth: wp.array[wp.float32],
) -> None:
    piece = first + wp.tid()
    row = piece // tiles_across
    across = piece - row * tiles_across
    begin = across * wp.static(TILE)
    count = wp.min(wp.static(TILE), width - begin)
    tile = (row // wp.static(TILE)) * tiles_across + across
    _blend_row(
        row, begin, count, row * width + begin, starts[tile], starts[tile + 1], order, centres, conics, opacities,
        colours, depths, background, picture, alpha, depth,
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def blend_adjoint(
    width: int,
    tiles_across: int,
    starts: wp.array[wp.int32],
    order: wp.array[wp.int32],
    centres: wp.array[wp.vec2f],
    conics: wp.array[wp.vec3f],
    opacities: wp.array[wp.float32],
    colours: wp.array[wp.vec3f],
    depths: wp.array[wp.float32],
    picture: wp.array[wp.vec3f],
    alpha: wp.array[wp.float32],
    depth: wp.array[wp.float32],
    # derivatives of the loss to what ``blend`` gave
    to_picture: wp.array[wp.vec3f],
    to_alpha: wp.array[wp.float32],
    to_depth: wp.array[wp.float32],
    # and to what it took, added up over the pixels
    to_centres: wp.array[wp.vec2f],
    to_conics: wp.array[wp.vec3f],
    to_opacities: wp.array[wp.float32],
    to_colours: wp.array[wp.vec3f],
    to_depths: wp.array[wp.float32],
) -> None:
    pixel = wp.tid()
    row = pixel // width
    column = pixel - row * width
    tile = (row // wp.static(TILE)) * tiles_across + column // wp.static(TILE)
    x = float(column) + 0.5
    y = float(row) + 0.5
    by_colour = to_picture[pixel]
    by_depth = to_depth[pixel]
    # all that is still behind: the background's share is in the picture, and what is left is 1 - alpha
    behind = (
        wp.dot(by_colour, picture[pixel]) + by_depth * depth[pixel] - to_alpha[pixel] * (1.0 - alpha[pixel])
    )
    left = wp.float32(1.0)
    for k in range(starts[tile], starts[tile + 1]):
        g = order[k]
        centre = centres[g]
        conic = conics[g]
        dx = x - centre[0]
        dy = y - centre[1]
        power = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy
        if power <= 0.0 and power >= wp.static(_LEAST_POWER):
            fall = wp.exp(power)
            a = wp.min(wp.static(_MOST_ALPHA), opacities[g] * fall)
            if a >= wp.static(_LEAST_ALPHA):
                after = left * (1.0 - a)
                if after < wp.static(_LEAST_LEFT):
                    break
                own = wp.dot(by_colour, colours[g]) + by_depth * depths[g]
                weight = left * a
                behind -= weight * own
                wp.atomic_add(to_colours, g, weight * by_colour)
                wp.atomic_add(to_depths, g, weight * by_depth)
                if opacities[g] * fall < wp.static(_MOST_ALPHA):
                    by_a = left * own - behind / (1.0 - a)
                    by_power = by_a * a
                    wp.atomic_add(to_opacities, g, by_a * fall)
                    wp.atomic_add(
                        to_centres,
                        g,
                        by_power * wp.vec2f(conic[0] * dx + conic[1] * dy, conic[2] * dy + conic[1] * dx),
                    )
                    wp.atomic_add(to_conics, g, by_power * wp.vec3f(-0.5 * dx * dx, -dx * dy, -0.5 * dy * dy))
                left = after
