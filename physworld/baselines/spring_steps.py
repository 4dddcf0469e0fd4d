"""Springs and dashpots in explicit steps, in Warp, and the gradient of what they did by ``wp.Tape``.

Points of mass 1; a spring of rest length l0 with stiffness Y [m/s²] and dashpot c [1/s], both per unit of mass, pulls
with Y (l / l0 - 1) + c (v_j - v_i)·n along n (Jiang et al. 2025, section 3). Air drag takes exp(-d dt) of every
velocity, gravity acts, and semi-implicit Euler steps. Collisions are impulses between force and motion: with a ground
z = h, and, where the body touches itself, between points without a spring that are nearer than a distance and come
closer; each with an elasticity and a friction, averaged over the points that are met. Held points follow their paths.

A *window* is a fixed number of steps that is captured as one graph, forwards and backwards: the state after it is the
start of the next. Gradients do not pass from a window to the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.baselines import spring_kernels
from physworld.baselines.spring_body import SpringBody
from physworld.errors import SimulationError

DEVICE = "cpu"
SAFETY = 0.4
"""Of the longest stable step: stiffness may grow by (1 / SAFETY)² in a spring or two before steps explode."""
SHORTEST_S = 5e-5
"""PhysTwin's own step; networks that need a shorter one are refused."""
LONGEST_S = 1e-3
_MET = 48  # points near each one, at most on average


@dataclass(frozen=True, eq=False)
class Springs:
    """Numbers of a network.

    Attributes:
        pairs: points that springs join, (S, 2).
        rest: lengths [m], (S,).
        stiffness, damping: logarithms of Y [m/s²] and c [1/s], (S,).
        drag: logarithm of d [1/s].
        collision: elasticity and friction at the ground, the same of the body against itself, and the distance [m]
            at which its points collide, (5,).
    """

    pairs: Array
    rest: Array
    stiffness: Array
    damping: Array
    drag: float
    collision: Array

    def stable_step(self, points: int) -> float:
        """SAFETY of the step [s] up to which no row of the network grows (Gershgorin's bound)."""
        pull, resist = np.zeros(points), np.zeros(points)
        for end in (0, 1):
            np.add.at(pull, self.pairs[:, end], np.exp(self.stiffness) / self.rest)
            np.add.at(resist, self.pairs[:, end], np.exp(self.damping))
        fastest = np.sqrt(2.0 * pull.max(initial=0.0))
        slowest = 2.0 * resist.max(initial=0.0)
        longest = min(2.0 / max(fastest, 1e-12), 2.0 / max(slowest, 1e-12))
        return SAFETY * float(longest)


@dataclass(frozen=True, eq=False)
class Gradient:
    """Of a sum over frames by the logarithms of ``Springs``: stiffness (S,), damping (S,), drag."""

    stiffness: Array
    damping: Array
    drag: float


class Run:
    """A network on its way through a recording."""

    def __init__(self, body: SpringBody, springs: Springs, window_s: float, gradient: bool = False) -> None:
        """Prepare the steps.

        Args:
            body: points, grips, ground.
            springs: the network.
            window_s: simulated time of a window [s].
            gradient: whether :meth:`descend` will be called.

        Raises:
            SimulationError: the springs are too stiff for steps of ``SHORTEST_S``, or there are none.
        """
        count, on = len(body.points), {"device": DEVICE}
        if not len(springs.pairs):
            raise SimulationError(f"no spring joins the {count} points")
        step = min(springs.stable_step(count), LONGEST_S)
        if step < SHORTEST_S:
            raise SimulationError(f"a stable step is {step:.2g} s, the shortest that is tried {SHORTEST_S} s")
        self.body, self.springs = body, springs
        self.steps = max(1, int(np.ceil(window_s / step)))
        self.dt = window_s / self.steps
        ends = np.concatenate([springs.pairs, springs.pairs[:, ::-1]])
        order = np.argsort(ends[:, 0], kind="stable")
        first = np.searchsorted(ends[order, 0], np.arange(count + 1))
        column = np.full(count, -1)
        column[body.held] = np.arange(len(body.held))
        ints = {
            "first": first, "other": ends[order, 1], "spring": np.tile(np.arange(len(springs.pairs)), 2)[order],
            "column": column, "met_first": np.zeros(count + 1),
        }  # fmt: skip
        self._on = {name: wp.array(of.astype(np.int32), dtype=int, **on) for name, of in ints.items()}
        self._met = wp.zeros(_MET * count, dtype=int, **on)
        self._rest, self._collision = (
            wp.array(np.asarray(of, dtype=np.float32), dtype=float, **on)
            for of in (springs.rest, springs.collision)
        )
        self._numbers = [
            wp.array(
                np.atleast_1d(np.asarray(of, dtype=np.float32)), dtype=float, requires_grad=gradient, **on
            )
            for of in (springs.stiffness, springs.damping, springs.drag)
        ]
        shape = (self.steps + 1, count)
        self._x, self._v, self._u = (
            wp.zeros(shape, dtype=wp.vec3, requires_grad=gradient, **on) for _ in range(3)
        )
        self._path = wp.zeros((self.steps + 1, max(len(body.held), 1)), dtype=wp.vec3, **on)
        self._joined = {(int(i), int(j)) for i, j in springs.pairs} if body.touches_itself else set()
        wp.load_module(spring_kernels, device=DEVICE)
        tape = wp.Tape()
        with wp.ScopedCapture(device=DEVICE) as forwards:
            if gradient:
                with tape:
                    self._launch()
            else:
                self._launch()
        self._forwards = forwards.graph
        if gradient:
            with wp.ScopedCapture(device=DEVICE) as backwards:
                tape.backward()
            self._backwards = backwards.graph

    def simulate(self, times: Array) -> Array:
        """Tracked points (T, N, 3) [m] in the world at ``times`` (T,) [s], the first of which is the start."""
        return self._along(times, None)[0]

    def descend(self, times: Array, of_tracks: Callable[[Array, Array], Array]) -> tuple[Array, Gradient]:
        """Tracked points (T, N, 3) [m], and the gradient of what ``of_tracks`` differentiates.

        Args:
            times: (T,) [s], the first of which is the start.
            of_tracks: of the numbers (F,) of a window's frames and the tracked points there (F, N, 3) [m], the
                gradient of what is summed over frames by these points, (F, N, 3).
        """
        return self._along(times, of_tracks)

    def _along(
        self, times: Array, of_tracks: Callable[[Array, Array], Array] | None
    ) -> tuple[Array, Gradient]:
        body = self.body
        since = np.maximum(times - times[0] - body.start_s, 0.0)
        after = np.ceil(since / self.dt - 1e-6).astype(int)  # the step that ends at a frame or behind it
        share = np.clip(since / self.dt - (after - 1), 0.0, 1.0)
        tracks = np.repeat(body.tracked(body.points[None]), len(times), axis=0)
        x, v = self._x.numpy(), self._v.numpy()
        x[0], v[0] = body.points, body.velocity
        for gained in self._numbers if of_tracks is not None else ():
            gained.grad.zero_()
        for start in range(0, int(after.max()), self.steps):
            moments = times[0] + body.start_s + self.dt * (start + np.arange(self.steps + 1))
            if len(body.held):
                self._path.numpy()[:] = body.held_at(moments)
                if start == 0:
                    x[0, body.held] = body.points[body.held]
            self._meet(x[0], v[0])
            wp.capture_launch(self._forwards)
            frames = np.flatnonzero((after > start) & (after <= start + self.steps))
            ends, late = after[frames] - start, share[frames, None, None]
            tracks[frames] = body.tracked(late * x[ends] + (1.0 - late) * x[ends - 1])
            if not np.isfinite(x[-1]).all():
                tracks[frames[0] if len(frames) else -1 :] = np.nan
                break
            if of_tracks is not None:
                self._back(ends, late, of_tracks(frames, tracks[frames]))
            x[0], v[0] = x[-1], v[-1]
        if of_tracks is None:
            return tracks, Gradient(np.empty(0), np.empty(0), 0.0)
        stiffness, damping, drag = (of.grad.numpy().astype(float) for of in self._numbers)
        return tracks, Gradient(stiffness, damping, float(drag[0]))

    def _back(self, ends: Array, late: Array, gradient: Array) -> None:
        """Add a window's share: ``gradient`` (F, N, 3) of points seen ``late`` (F, 1, 1) in the steps to ``ends``."""
        for of in (self._x, self._v, self._u):
            of.grad.zero_()
        by_points = self.body.pulled_back(gradient)
        np.add.at(self._x.grad.numpy(), ends, (late * by_points).astype(np.float32))
        np.add.at(self._x.grad.numpy(), ends - 1, ((1.0 - late) * by_points).astype(np.float32))
        wp.capture_launch(self._backwards)

    def _launch(self) -> None:
        count, body = len(self.body.points), self.body
        ground = -1e9 if body.ground is None else body.ground
        model = [
            *(self._on[name] for name in ("first", "other", "spring")),
            self._rest,
            *self._numbers,
            wp.vec3(*body.gravity),
        ]
        met = [self._collision, self._on["met_first"], self._met]
        for step in range(self.steps):
            wp.launch(
                spring_kernels.push,
                count,
                [step, self.dt, *model, self._x, self._v],
                outputs=[self._u],
                device=DEVICE,
            )
            wp.launch(
                spring_kernels.move,
                count,
                [step, self.dt, self._on["column"], self._path, ground, *met, self._u],
                outputs=[self._x, self._v],
                device=DEVICE,
            )

    def _meet(self, x: Array, v: Array) -> None:
        """Which points without a spring between them may come within the distance of collisions in this window."""
        if not self.body.touches_itself:
            return
        span = self.steps * self.dt
        fast = float(np.linalg.norm(v, axis=1).max()) + float(np.linalg.norm(self.body.gravity)) * span
        reach = float(self.springs.collision[4]) + 2.0 * fast * span
        pairs = cKDTree(x).query_pairs(reach, output_type="ndarray")
        pairs = np.array([p for p in pairs if (int(p[0]), int(p[1])) not in self._joined]).reshape(-1, 2)
        ends = np.concatenate([pairs, pairs[:, ::-1]]).astype(int)
        if len(ends) > len(self._met):
            raise SimulationError(f"{len(ends)} near pairs of points, room for {len(self._met)}")
        ends = ends[np.argsort(ends[:, 0], kind="stable")]
        self._on["met_first"].assign(np.searchsorted(ends[:, 0], np.arange(len(x) + 1)).astype(np.int32))
        self._met.numpy()[: len(ends)] = ends[:, 1]
