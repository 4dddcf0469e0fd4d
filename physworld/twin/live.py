"""A twin that is stepped by hand: where the control points go in, particles out, one tick at a time.

The run is that of :meth:`Twin.simulate`, kept open. Its knots are the release and two ticks; the second interval is
integrated again and again, its ends led along the paths that come, so that whatever remembers the run (velocities,
friction, creep, plastic strain) goes on. Between two ticks a grip follows the cubic that begins with the last tick's
mean velocity and ends with its own: what comes later is not known yet, so that a live run differs from one under the
finished track by how much the velocities change from tick to tick.

What needs the whole track beforehand is refused: colliders that move, twist between the grips of a straight rope, a
rest shape that is driven from inside, grips that open at recorded times, grips that pull instead of prescribing, a
stiffness that grows with time; and the updated Lagrangian form, whose runs are not kept open.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.effects.base import Effect
from physworld.effects.registry import in_order
from physworld.engine.formulations import RODS, TOTAL
from physworld.engine.problem import HeldNodes
from physworld.engine.rods.discrete_rods import Launch
from physworld.engine.terms.colliders import BoundCollider
from physworld.engine.terms.soft_grips import BoundSoftGrips, SoftGrips
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.formulation import Run
from physworld.errors import SceneUnsupported
from physworld.twin.integration import Integration
from physworld.twin.openings import held_paths
from physworld.twin.rods import sections_of
from physworld.twin.twin import Twin

_TRACK_TICKS = 600
"""Ticks of the control track that are kept for effects of the grips' actuation."""


class LiveTwin:
    """See the module's text.

    Attributes:
        twin: what is stepped.
        tick: intervals so far.
        controllers: where the control points are, (K, 3) [m].
    """

    def __init__(
        self,
        twin: Twin,
        dt_s: float,
        *,
        properties: Array | None = None,
        lead_s: float = 0.0,
        before: LiveTwin | None = None,
    ) -> None:
        """At the release, under still grips, or where another run of the same body is.

        Args:
            twin: calibrated.
            dt_s: a tick [s].
            properties: as of :meth:`Twin.simulate`, (P, 2), or None.
            lead_s: length of the first interval where it is no tick [s].
            before: the run that this one carries on, with other parameters or properties.

        Raises:
            SceneUnsupported: the twin has something that a live run cannot lead; the message says what.
        """
        refuse(twin)
        self.twin, self._dt_s = twin, dt_s
        self._effects, self._gripped = in_order(twin.effects), twin.gripped()
        self.tick, self.controllers = 0, twin.controllers_start.copy()
        if before is not None:
            self.tick, self.controllers = before.tick, before.controllers
        times = twin.release_s + np.array([0.0, lead_s or dt_s, (lead_s or dt_s) + dt_s])
        still = np.repeat(self.controllers[None], 3, axis=0)
        run = twin.integration(times, still, times, properties=properties)
        solver = twin.solver(run.problem)
        _refuse_terms(run, solver.terms)
        self._held: HeldNodes = before._held if before else held_paths(self._gripped, run.knots, still)
        self._lengths = np.diff(run.knots)
        self._times, self._track = [float(run.knots[0])], [self.controllers]
        self._nodes = twin.carriers_start
        if before is not None:
            self._nodes, self._times, self._track = before._nodes, before._times, before._track
        opened = _OpenRods if twin.form is RODS else _OpenNodes
        self._open: _OpenNodes | _OpenRods = opened(
            solver, run, twin.body.start if before is None else before._nodes
        )
        if before is not None:
            self._open.carry_on(before._open)

    def changed(self, twin: Twin, properties: Array | None = None) -> LiveTwin:
        """The same motion carried on by a twin with other parameters, strengths of its effects or properties.

        Args:
            twin: of the same body and grips.
            properties: as of :meth:`Twin.simulate`, (P, 2), or None.
        """
        return LiveTwin(twin, self._dt_s, properties=properties, before=self)

    @property
    def particles(self) -> Array:
        """Particles now, (P, 3) [m]."""
        found: Array = self.twin.particles_at(self._nodes[None])[0]
        return found

    def step(self, controllers: Array) -> Array:
        """Move all control points to (K, 3) [m] within a tick; the particles then, (P, 3) [m].

        Raises:
            SimulationError: the run cannot be trusted; the message has the numbers.
        """
        length = self._lengths[min(self.tick, 1)]
        self._times = [*self._times, self._times[-1] + length][-_TRACK_TICKS:]
        self._track = [*self._track, np.asarray(controllers, dtype=float)][-_TRACK_TICKS:]
        ends = self._ends()
        self._held = self._led(ends, length)
        turns = None
        if self.twin.form is RODS:
            turns = sections_of(self._gripped, self._held, np.array([0.0, length]), ends).turns[1]
        self._nodes = self._open.advance(self._held, turns)
        self.tick, self.controllers = self.tick + 1, self._track[-1]
        return self.particles

    def _ends(self) -> Array:
        """Control points that the body follows at the interval's ends, (2, K, 3) [m]."""
        times, points = np.array(self._times), np.array(self._track)
        wanted = times[-2:]
        for known in self._effects:
            times, points = known.controls(times, points)
        if len(times) == len(wanted) and np.array_equal(times, wanted):
            return points
        flat = points.reshape(len(points), -1)
        place = np.clip(np.searchsorted(times, wanted, side="right"), 1, len(times) - 1)
        share = np.clip((wanted - times[place - 1]) / (times[place] - times[place - 1]), 0.0, 1.0)[:, None]
        mixed: Array = (1.0 - share) * flat[place - 1] + share * flat[place]
        return mixed.reshape(len(wanted), *points.shape[1:])

    def _led(self, ends: Array, length: float) -> HeldNodes:
        """Paths of all held nodes at the interval's ends; the velocity at its beginning is that of the last end."""
        paths = held_paths(self._gripped, np.array([0.0, length]), ends)
        velocities = np.stack([self._held.velocities[-1], paths.velocities[1]])
        return HeldNodes(paths.nodes, paths.positions, velocities)


def refuse(twin: Twin) -> None:
    """Raises SceneUnsupported for a twin that cannot be run live; the message says why."""
    if twin.form not in (TOTAL, RODS):
        raise SceneUnsupported(f"a run of the {twin.form.title} form cannot be kept open")
    if twin.openings:
        raise SceneUnsupported("its grips open and close at recorded times")
    if twin.drive is not None:
        raise SceneUnsupported(
            f"{len(twin.drive)} steps of the rest shape are driven from inside at recorded times"
        )
    moving = [one.declared.name for one in twin.colliders if one.declared.controllers or len(one.times) > 1]
    if moving:
        raise SceneUnsupported(f"the colliders {', '.join(moving)} move along recorded paths")
    pulling = [
        known.name for known in twin.effects if known.active and type(known).attach is not Effect.attach
    ]
    if pulling:
        raise SceneUnsupported(f"{', '.join(pulling)} pulls along the whole path of the grips")


def _refuse_terms(run: Integration, bound: Any) -> None:
    """Raises SceneUnsupported where a term reads times or paths that a live run does not rewrite."""
    for term, made in zip(run.problem.terms, bound, strict=True):
        if not isinstance(made, BoundCollider) and getattr(type(made), "begin", None) is not BoundTerm.begin:
            raise SceneUnsupported(
                f"{type(term).__name__} reads the whole track of the grips, or the time since the start"
            )


def _copied(new: tuple[wp.array, ...], old: tuple[wp.array, ...]) -> None:
    """Take the contents of arrays where they fit."""
    for into, taken in zip(new, old, strict=False):
        if into.shape == taken.shape and into.dtype == taken.dtype:
            wp.copy(into, taken)


class _OpenNodes:
    """Nodes of the total Lagrangian form."""

    def __init__(self, solver: Any, run: Integration, nodes: Array) -> None:
        self._run, self._terms = Run(solver, nodes, run.velocity, run.held, run.knots), solver.terms
        self._paths = [(run.held.nodes, self._run.paths)]
        for term, bound in zip(run.problem.terms, solver.terms, strict=True):
            if isinstance(term, SoftGrips) and isinstance(bound, BoundSoftGrips):
                self._paths.append((term.held.nodes, bound.paths))
        self._frame = 0

    def carry_on(self, before: Any) -> None:
        """Take velocities and memory from another run; positions are its already. Memory is not begun anew."""
        _copied((self._run.v,), (before._run.v,))
        for new, old in zip(self._terms, before._terms, strict=False):
            _copied(new.memory, old.memory)
        self._frame = 1

    def advance(self, paths: HeldNodes, turns: Array | None) -> Array:
        """Integrate an interval under paths at its two ends; the nodes at its end, (n, 3) [m]."""
        order = np.argsort(paths.nodes, kind="stable")
        for nodes, arrays in self._paths:
            if not len(nodes):
                continue
            rows = order[np.searchsorted(paths.nodes, nodes, sorter=order)]
            for array, values in zip(arrays, (paths.positions, paths.velocities), strict=True):
                whole = array.numpy()
                whole[self._frame : self._frame + 2] = values[:, rows].reshape(2, -1)
                array.assign(whole)
        moved = self._run.advance(self._frame)
        self._frame = 1
        return moved


class _OpenRods:
    """A discrete rod."""

    def __init__(self, solver: Any, run: Integration, nodes: Array) -> None:
        self._launch = Launch(solver, nodes, run.velocity, [run.held], run.knots)
        self._nodes, self._frame = run.held.nodes, 0
        self._settles = bool(self._launch.rods.sections[0].settles)
        self._turned = np.zeros(self._launch.path[2].shape[2])

    def carry_on(self, before: Any) -> None:
        """Take directors, velocities, friction and creep from another run; positions are its already."""
        _copied(tuple(self._launch.state), tuple(before._launch.state))
        self._turned, self._settles = before._turned, False

    def advance(self, paths: HeldNodes, turns: Array | None) -> Array:
        """Integrate an interval under paths at its two ends, turned by so much; the nodes at its end, (n, 3) [m]."""
        if self._settles:  # under still grips, as they are at the start
            self._launch.settle()
            self._settles = False
        order = np.argsort(paths.nodes, kind="stable")
        rows = order[np.searchsorted(paths.nodes, self._nodes, sorter=order)]
        before, self._turned = self._turned, self._turned + (0.0 if turns is None else turns)
        led = (paths.positions[:, rows], paths.velocities[:, rows], np.stack([before, self._turned]))
        for array, values in zip(self._launch.path[:3], led, strict=True):
            whole = array.numpy()
            whole[0, self._frame : self._frame + 2] = values
            array.assign(whole)
        moved = self._launch.interval(self._frame)
        self._frame = 1
        return moved
