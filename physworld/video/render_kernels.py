"""Warp kernels of the renderer: one thread a pixel, from ``first`` on, front to back over the Gaussians of its tile."""

from __future__ import annotations

import math

import warp as wp

TILE = 8
_LEAST_ALPHA = 1.0 / 255.0
_LEAST_POWER = math.log(_LEAST_ALPHA) - 1e-3  # below it no opacity shows, and the exponential is spared
_MOST_ALPHA = 0.99
_LEAST_LEFT = 1e-4


@wp.kernel
def blend(
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
    pixel = first + wp.tid()
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


@wp.kernel
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
