"""Demonstrations in which a grip lets go of the object for a while and takes hold of the same material again.

Where the material is when the hand closes is known only once it was simulated, so an episode is simulated twice: up to
the moment at which the hand closes, and then as a whole, with the hand led on from there. The hand meets the material
with the material's own speed and gives that up within ``EASE_S``; what it was planned to do comes on top:

    R(t) = R_h(t) R_h(c)^T R_m        p(t) = p_m + p_h(t) - p_h(c) + v_m E (1 - exp(-(t - c) / E))

with R_h, p_h the planned turn and centre of the hand, R_m, p_m, v_m those of the material when the hand closes, at c.

The control points that an episode keeps go along with the material while the hand is open, so that they are continuous,
and stand to what they hold as at the start whenever they hold it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.motion import keeps_spread, largest_share
from physworld.geometry.rigid import rigid_motion
from physworld.twin.openings import Opening

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

EASE_S = 0.15
BEGINS, LASTS = (0.15, 0.5), (0.1, 0.35)
"""Shares of an episode: when a grip opens, and for how long."""
SHORTEST_TICKS = 4
_SPEED_OVER_S = 1e-3  # before the hand closes, over which the material's speed is taken


@dataclass(frozen=True)
class Regrasp:
    """Grip ``grip`` is open from ``open_s`` to ``close_s`` [s]."""

    grip: int
    open_s: float
    close_s: float

    def openings(self, grips: int) -> tuple[Opening | None, ...]:
        """As a twin of so many grips has them."""
        return tuple(
            Opening(((self.open_s, self.close_s),)) if number == self.grip else None
            for number in range(grips)
        )


def able(twin: Twin) -> tuple[int, ...]:
    """Grips that may let go: those that hold something at the start, where another one does too."""
    holding = tuple(number for number, nodes in enumerate(twin.held_nodes) if len(nodes))
    return holding if len(holding) > 1 and not twin.form.on_particles else ()


def takes_elsewhere(twin: Twin) -> bool:
    """Whether a grip of the recording may take hold of other material than at its start, which is not replayed."""
    return any(
        one is not None and (one.radius_m is not None or not len(nodes))
        for one, nodes in zip(twin.openings, twin.held_nodes, strict=False)
    )


def drawn_regrasp(twin: Twin, times: Array, generator: np.random.Generator) -> Regrasp | None:
    """One of the grips, and when it opens and closes, at ticks (T,) [s]; None where no grip may, or time is short."""
    grips, last = able(twin), len(times) - 1
    if not grips or last < 3 * SHORTEST_TICKS:
        return None
    begin = max(SHORTEST_TICKS, round(last * generator.uniform(*BEGINS)))
    end = begin + max(SHORTEST_TICKS, round(last * generator.uniform(*LASTS)))
    end = min(end, last - 1)
    return Regrasp(int(generator.choice(grips)), float(times[begin]), float(times[end]))


def material_poses(twin: Twin, grip: int, nodes: Array) -> tuple[Array, Array]:
    """Rotations (T, 3, 3) and shifts (T, 3) [m] since the start of the material that a grip held there.

    Of the particles between held nodes alone, since a node beside the body says little; of the nodes where there are
    none. ``nodes``: carriers (T, n, 3) [m].
    """
    lattice, held = twin.lattice, twin.held_nodes[grip]
    share = np.asarray(lattice.interpolation(lattice.particle_coordinates)[:, held].sum(axis=1)).ravel()
    inside = np.flatnonzero((share > 1.0 - 1e-9) & (lattice.particle_measures > 0.0))
    if not len(inside):
        return rigid_motion(twin.body.start[held], nodes[:, held])
    return rigid_motion(twin.particles_start[inside], twin.particles_at(nodes)[:, inside])


def led_on(
    twin: Twin, regrasp: Regrasp, times: Array, points: Array, simulated: Array, limits: MotionLimits
) -> Array:
    """Control points (S, K, 3) [m] of a hand that closes on the material where it is.

    Args:
        twin: whose grip it is.
        regrasp: when the hand closes.
        times, points: control times (S,) [s] and the planned points (S, K, 3) [m].
        simulated: carriers shortly before and at the moment at which it closes (``closing_times``), (2, n, 3) [m].
        limits: of the grips' spread; what was planned is made smaller after the hand has closed until it keeps them.
    """
    group = twin.controller_groups[regrasp.grip]
    start, close = twin.controllers_start[group], regrasp.close_s
    turns, shifts = material_poses(twin, regrasp.grip, simulated)
    before, here = np.einsum("tij,kj->tki", turns, start) + shifts[:, None]
    middle = here.mean(axis=0)
    velocity = (middle - before.mean(axis=0)) / _SPEED_OVER_S
    after = times >= close - 1e-9
    planned, centres = rigid_motion(start, points[after][:, group])[0], points[after][:, group].mean(axis=1)
    coasting = velocity * EASE_S * (1.0 - np.exp(-(times[after] - close) / EASE_S))[:, None]
    arms = (start - start.mean(axis=0)) @ turns[1].T @ planned[0] @ planned.transpose(0, 2, 1)

    def led(share: float) -> Array:
        moved = points.copy()
        ahead = middle + coasting + share * (centres - centres[0])
        moved[np.ix_(np.flatnonzero(after), group)] = ahead[:, None] + arms
        return moved

    def kept(share: float) -> bool:
        moved = led(share)[after]
        return keeps_spread(np.stack([moved[:, own].mean(axis=1) for own in limits.grips], axis=1), limits)

    return led(largest_share(kept))


def closing_times(first_s: float, close_s: float) -> Array:
    """When :func:`led_on` wants the carriers: the start, shortly before the hand closes, and then, (3,) [s]."""
    return np.array([first_s, close_s - _SPEED_OVER_S, close_s])


def along_with_the_material(twin: Twin, controllers: Array, nodes: Array, holding: Array) -> Array:
    """Controllers (T, K, 3) [m] that stand to what each grip held at the start as they did then, in every frame.

    While a grip is open they go along with that material, and from when it has closed they move on as the hand does.

    Args:
        twin: of the episode.
        controllers: as the hands moved, (T, K, 3) [m].
        nodes: carriers at the frames, (T, n, 3) [m].
        holding: whether each grip holds from each frame to the next, (T, G).
    """
    found = controllers.copy()
    for number, group in enumerate(twin.controller_groups):
        start = twin.controllers_start[group]
        if not len(twin.held_nodes[number]) or holding[:, number].all():
            continue
        turns, shifts = material_poses(twin, number, nodes)
        along = np.einsum("tij,kj->tki", turns, start) + shifts[:, None]
        hand, moved = rigid_motion(start, controllers[:, group])
        closed = -1  # frame at which it took hold again; -1: it has not let go yet
        for frame in range(len(holding)):
            if not holding[frame, number]:
                found[frame, group] = along[frame]
                closed = frame + 1
            elif closed >= 0:
                local = (along[closed] - moved[closed]) @ hand[closed]
                found[frame, group] = local @ hand[frame].T + moved[frame]
    return found
