"""Cloths by an engine that is not ours: MuJoCo flex, undamped, a third of each triangle's mass at its corners."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.finite_elements import Acting, Floats, Place
from benchmarks.peers.flex_sheet import FlexSheet


@dataclass(frozen=True)
class Mesh(FlexSheet):
    """A sheet of triangles that weigh alike at their corners, and what acts on it."""

    def masses(self) -> Floats:
        """Of the vertices (V,) [kg]."""
        triangles = self.triangles()
        total = self.density_kg_m3 * self.thickness_m * self.size_m[0] * self.size_m[1]
        mass = np.zeros(len(self.vertices()))
        np.add.at(mass, triangles, total / (3 * len(triangles)))
        return mass

    def record(
        self, acting: Acting, grips: list[tuple[NDArray[np.int64], Place]], places: Floats, times: Floats
    ) -> Floats:
        """Points (T, N, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            grips: vertices that are held, and how each hold moves.
            places: of the points, shares of the sheet's sides (N, 2).

        Raises:
            FloatingPointError: the recording blew up.
        """
        steps = round(self.steps * (times[1] - times[0]) * 30.0)
        frames = stepped(self.model(), self.vertices(), self.masses(), acting, grips, times, steps)
        return self.between(frames, places)

    def between(self, nodes: Floats, places: Floats) -> Floats:
        """Tracks (T, N, 3) of places (N, 2) between 0 and 1 of the sheet, linear in its triangles."""
        corners = self.triangles()
        flat = self.vertices()[:, [0, 2]]
        targets = flat.min(axis=0) + places * self.size_m
        first, sides = flat[corners[:, 0]], flat[corners[:, 1:]] - flat[corners[:, :1]]
        inverse = np.linalg.inv(np.swapaxes(sides, 1, 2))
        local = np.einsum("tij,ptj->pti", inverse, targets[:, None] - first)
        weights = np.concatenate([1.0 - local.sum(axis=2, keepdims=True), local], axis=2)
        own = np.argmax(weights.min(axis=2), axis=1)
        taken = weights[np.arange(len(places)), own]
        return np.einsum("pk,tpki->tpi", taken, nodes[:, corners[own]])


def stepped(
    model: mujoco.MjModel,
    rest: Floats,
    mass: Floats,
    acting: Acting,
    grips: list[tuple[NDArray[np.int64], Place]],
    times: Floats,
    steps: int,
) -> Floats:
    """Vertices (T, V, 3) [m] of a flex at evenly spaced times (T,) [s], in so many steps a frame.

    Args:
        rest, mass: of the vertices, (V, 3) [m] and (V,) [kg].
        grips: vertices that are held, and how each hold moves: they are set there after every step.

    Raises:
        FloatingPointError: the recording blew up.
    """
    model.opt.timestep = (times[1] - times[0]) / steps
    model.opt.gravity[:] = acting.gravity_m_s2
    data = mujoco.MjData(model)
    near = np.linalg.norm(rest - acting.attach, axis=1) <= acting.tether_radius_m
    tied = np.where(near, mass, 0.0) / max(float(mass[near].sum()), 1e-30)
    frames = [rest.copy()]
    for count in range(1, (len(times) - 1) * steps + 1):
        data.qfrc_applied[:] = _pushes(acting, rest, mass, tied, data).ravel()
        mujoco.mj_step(model, data)
        now, before = count * model.opt.timestep, (count - 1) * model.opt.timestep
        for nodes, place in grips:
            ways = [_moved(rest[nodes], place, time) for time in (now, before)]
            rows = (3 * nodes[:, None] + np.arange(3)).ravel()
            data.qpos[rows] = ways[0].ravel()
            data.qvel[rows] = ((ways[0] - ways[1]) / model.opt.timestep).ravel()
        if count % steps == 0:
            frames.append(rest + data.qpos.reshape(-1, 3))
    if not np.isfinite(frames).all():
        raise FloatingPointError(f"the recording blew up at steps of {model.opt.timestep:.3g} s")
    return np.stack(frames)


def _pushes(acting: Acting, rest: Floats, mass: Floats, tied: Floats, data: mujoco.MjData) -> Floats:
    """Forces beside gravity and elasticity, (V, 3) [N]."""
    v = data.qvel.reshape(-1, 3)
    pull = acting.linear_drag_per_s + acting.quadratic_drag_per_m * np.linalg.norm(v, axis=1)
    force = -(mass * pull)[:, None] * v
    if acting.push is not None:
        force += mass[:, None] * acting.push(data.time)
    if acting.tether_n_m:
        reach = acting.anchor - tied @ (rest + data.qpos.reshape(-1, 3))
        length = float(np.linalg.norm(reach))
        force += np.outer(tied, acting.tether_n_m * (length - acting.tether_rest_m) * reach / length)
    return force


def _moved(places: Floats, place: Place, time: float) -> Floats:
    """Ways (N, 3) [m] from rest of what a hold carries."""
    turn, shift = place(time)
    centre = places.mean(axis=0)
    return (places - centre) @ turn.T + centre + shift - places
