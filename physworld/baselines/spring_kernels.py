"""Device code of :mod:`physworld.baselines.spring_steps`: one step of springs, dashpots and collisions."""

from __future__ import annotations

import warp as wp


@wp.kernel
def push(
    step: wp.int32,
    dt: wp.float32,
    first: wp.array[wp.int32],
    other: wp.array[wp.int32],
    spring: wp.array[wp.int32],
    rest: wp.array[wp.float32],
    stiffness: wp.array[wp.float32],
    damping: wp.array[wp.float32],
    drag: wp.array[wp.float32],
    gravity: wp.vec3,
    x: wp.array2d[wp.vec3],
    v: wp.array2d[wp.vec3],
    u: wp.array2d[wp.vec3],
) -> None:
    """Velocity after the forces of all springs of a point; ``stiffness``, ``damping`` and ``drag`` are logarithms."""
    i = wp.tid()
    here = x[step, i]
    speed = v[step, i]
    force = gravity
    for k in range(first[i], first[i + 1]):
        j = other[k]
        s = spring[k]
        along = x[step, j] - here
        length = wp.length(along) + 1.0e-9
        unit = along / length
        size = wp.exp(stiffness[s]) * (length / rest[s] - 1.0)
        size = size + wp.exp(damping[s]) * wp.dot(v[step, j] - speed, unit)
        force = force + size * unit
    u[step, i] = (speed + dt * force) * wp.exp(-dt * wp.exp(drag[0]))


@wp.func
def bounced(
    speed: wp.vec3,
    normal: wp.vec3,
    elasticity: wp.float32,
    friction: wp.float32,
    share: wp.float32,
) -> wp.vec3:
    """What a collision adds to a velocity ``speed`` relative to what is hit, against ``normal`` (Coulomb's law)."""
    into = wp.dot(speed, normal)
    across = speed - into * normal
    slip = wp.length(across) + 1.0e-9
    stop = wp.min(friction * (1.0 + elasticity) * wp.abs(into) / slip, 1.0)
    return share * (-(1.0 + elasticity) * into * normal - stop * across)


@wp.kernel
def move(
    step: wp.int32,
    dt: wp.float32,
    column: wp.array[wp.int32],
    path: wp.array2d[wp.vec3],
    ground: wp.float32,
    collision: wp.array[wp.float32],
    met_first: wp.array[wp.int32],
    met: wp.array[wp.int32],
    u: wp.array2d[wp.vec3],
    x: wp.array2d[wp.vec3],
    v: wp.array2d[wp.vec3],
) -> None:
    """Collisions and motion; ``collision``: elasticity and friction of the ground, of the body itself, its distance."""
    i = wp.tid()
    here = x[step, i]
    held = column[i]
    if held >= 0:
        x[step + 1, i] = path[step + 1, held]
        v[step + 1, i] = (path[step + 1, held] - path[step, held]) / dt
    else:
        speed = u[step, i]
        given = wp.vec3(0.0, 0.0, 0.0)
        count = wp.float32(0.0)
        for k in range(met_first[i], met_first[i + 1]):
            j = met[k]
            apart = here - x[step, j]
            distance = wp.length(apart) + 1.0e-9
            normal = apart / distance
            relative = u[step, i] - u[step, j]
            if distance < collision[4] and wp.dot(relative, normal) < 0.0:
                share = wp.float32(0.5)
                if column[j] >= 0:
                    share = wp.float32(1.0)
                given = given + bounced(relative, normal, collision[2], collision[3], share)
                count = count + 1.0
        speed = speed + given / wp.max(count, 1.0)
        if here[2] + dt * speed[2] < ground and speed[2] < 0.0:
            speed = speed + bounced(speed, wp.vec3(0.0, 0.0, 1.0), collision[0], collision[1], 1.0)
        v[step + 1, i] = speed
        x[step + 1, i] = here + dt * speed
