"""The digital twin: a reference body, its law, its grips, and the simulations that they allow.

A twin is immutable; :meth:`Twin.with_parameters` gives a changed one. Positions go in and out in world coordinates
[m]; a twin's *particles* are the quadrature points of its lattice, and its *tracked points* are the measured points of
the scene followed as material points. What a simulation returns are its *carriers*: the nodes of the lattice in the
total Lagrangian form, the particles in the updated one (:mod:`physworld.engine.formulations` says which is taken);
:meth:`particles_at`, :meth:`track_nodes` and :meth:`observe` read either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.sparse.linalg import splu

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.effects.base import Effect
from physworld.effects.registry import in_order
from physworld.engine.formulations import FORMULATIONS, Course, Formulation
from physworld.engine.lattice.following import follow
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact, ground, touching
from physworld.engine.terms.soft_grips import soften
from physworld.engine.terms.term import Term
from physworld.engine.thin.self_contact import SelfContact
from physworld.engine.updated.transfer import Apic
from physworld.errors import EffectRefused, SceneUnsupported
from physworld.geometry.body import ReferenceBody, applied, material_tracks
from physworld.materials.laws import Law
from physworld.materials.plastic import Plasticity
from physworld.twin.arrays import arrays_of, parts_of
from physworld.twin.colliders import TwinCollider
from physworld.twin.grips import soft_regions, twist_between_grips, with_touched_nodes
from physworld.twin.integration import Integration, solver_knots
from physworld.twin.openings import Opening, held_paths, switch_times
from physworld.twin.properties import together
from physworld.twin.rods import sections_of

Progress = Callable[[int, int], None]

_SMOOTHING = 1e-9  # against particle positions: felt only by what particles do not see
_EARLIEST_RELEASE_S = 1e-6  # after the first frame, of a body that was held


@dataclass(frozen=True)
class Twin:
    """See the module's text.

    Attributes:
        body: reference lattice, start, tracked points.
        law: constitutive parameters.
        gravity_m_s2: (3,).
        air_drag_per_s: linear drag rate [1/s].
        ground_height_m, ground_friction: ground plane, or None.
        controller_groups: controllers that move as one rigid grip.
        held_nodes: nodes that each grip holds, one array a group.
        controllers_start: controllers at the first frame [m], (K, 3).
        release_s: the body is held at its start until then (somebody let go of it).
        release_delay_s: how much of that is later than the recording shows the first motion.
        grip_softness: of a solid, cells over which a grip's hold sets in (:mod:`physworld.engine.terms.soft_grips`); 0:
        every
            node that gripped material touches is prescribed. Total Lagrangian only.
        grip_regions: box that each grip of a solid holds at the start, (2, 3) [m], or None where none is declared.
        turning: numbers of the groups whose control points show how a rope's section turns about its axis; between
            two of them the rope carries twist (:mod:`physworld.engine.thin.twist`).
        effects: what acts beside the declared physics.
        colliders: rigid bodies that push, still, on their own track or carried by controllers.
        self_friction: Coulomb's coefficient of a rope or sheet against itself; None: it passes through itself.
        plasticity: flow law, or None; updated Lagrangian only.
        formulation: name of the form that integrates the body; :attr:`form` is the form itself.
        transfer: how particles and grid exchange velocities, "apic" or "asflip"; updated Lagrangian only.
        properties: the fields of the local stage, or None: log factors of stiffness and density, (P, 2), or with the
            ground's friction (P, 3), under everything that a run is given.
        natural: of a discrete rod, what its curvature and twist are made of (:mod:`physworld.twin.rods`), (R, 3).
        drive: of a discrete rod, steps of its rest shape that are driven from inside, (J, 6); None of others.
        openings: when each grip is open, None for one that always holds; empty where all do.
        device: Warp device of the simulations; not part of the twin's identity.
    """

    body: ReferenceBody
    law: Law
    gravity_m_s2: Array
    air_drag_per_s: float
    ground_height_m: float | None
    ground_friction: float
    controller_groups: tuple[Array, ...]
    held_nodes: tuple[Array, ...]
    controllers_start: Array
    release_s: float = 0.0
    release_delay_s: float = 0.0
    grip_softness: float = 0.0
    grip_regions: tuple[Array | None, ...] = ()
    turning: tuple[int, ...] = ()
    effects: tuple[Effect, ...] = ()
    colliders: tuple[TwinCollider, ...] = ()
    self_friction: float | None = None
    plasticity: Plasticity | None = None
    formulation: str = "total_lagrangian"
    transfer: str = Apic.name
    properties: Array | None = None
    natural: Array | None = None
    drive: Array | None = None
    openings: tuple[Opening | None, ...] = ()
    device: str = field(default_factory=default_device)

    @property
    def lattice(self) -> Lattice:
        """The reference lattice."""
        return self.body.lattice

    @property
    def form(self) -> Formulation:
        """The form that integrates the body."""
        return FORMULATIONS[self.formulation]

    @cached_property
    def _particle_rows(self) -> Any:
        return self.lattice.interpolation(self.lattice.particle_coordinates)

    @property
    def particles_rest(self) -> Array:
        """Particles of the body without stress [m], (P, 3)."""
        particles: Array = self._particle_rows @ self.body.rest
        return particles

    @property
    def particles_start(self) -> Array:
        """Particles at the first frame [m], (P, 3)."""
        particles: Array = self._particle_rows @ self.body.start
        return particles

    @property
    def particle_mass(self) -> Array:
        """Mass of every particle [kg], (P,)."""
        return self.density * self.lattice.particle_measures

    @property
    def density(self) -> float:
        """Mass per volume, area or length [kg/m**d]."""
        return self.law.density

    @property
    def parameters(self) -> dict[str, float]:
        """Every scalar that a calibration may change, by name (units in the names)."""
        values = {**asdict(self.law), "air_drag_per_s": self.air_drag_per_s}
        if self.plasticity is not None:
            values.update(asdict(self.plasticity))
        if self.ground_height_m is not None:
            values["ground_friction"] = self.ground_friction
        if self.self_friction is not None:
            values["self_friction"] = self.self_friction
        if self.release_s > 0.0:
            values["release_delay_s"] = self.release_delay_s
        return values

    def with_parameters(self, **values: float) -> Twin:
        """A twin with other parameters; names are those of :attr:`parameters`. Raises KeyError for an unknown one."""
        law_names = {f.name for f in fields(self.law)}
        own = {"air_drag_per_s", "ground_friction", "self_friction", "release_delay_s"} & set(self.parameters)
        flow_names = set() if self.plasticity is None else {f.name for f in fields(self.plasticity)}
        unknown = set(values) - law_names - own - flow_names
        if unknown:
            raise KeyError(f"unknown parameters {sorted(unknown)}; this twin has {sorted(self.parameters)}")
        own_values: dict[str, Any] = {k: float(v) for k, v in values.items() if k in own}
        law_values: dict[str, Any] = {k: float(v) for k, v in values.items() if k in law_names}
        flow_values: dict[str, Any] = {k: float(v) for k, v in values.items() if k in flow_names}
        if "release_delay_s" in own_values:
            seen = self.release_s - self.release_delay_s
            own_values["release_delay_s"] = max(own_values["release_delay_s"], _EARLIEST_RELEASE_S - seen)
            own_values["release_s"] = seen + own_values["release_delay_s"]
        law = replace(self.law, **law_values)
        flow = self.plasticity
        if flow is not None:
            flow = replace(flow, **flow_values)
        return replace(self, law=law, plasticity=flow, **own_values)

    def with_effect(self, added: Effect) -> Twin:
        """A twin with this effect, in the place of one of the same name if there is one.

        Raises:
            EffectRefused: the effect makes no sense for this twin; the message says why.
        """
        reason = added.why_not(self)
        if reason is not None:
            raise EffectRefused(f"{added.name}: {reason}")
        names = [known.name for known in self.effects]
        if added.name in names:
            place = names.index(added.name)
            return replace(self, effects=(*self.effects[:place], added, *self.effects[place + 1 :]))
        return replace(self, effects=(*self.effects, added))

    def simulate(
        self,
        control_times: Array,
        control_points: Array,
        frame_times: Array,
        *,
        properties: Array | None = None,
        progress: Progress | None = None,
        from_rest: bool = False,
    ) -> Array:
        """Particles (P, 3) [m] at every frame, (T, P, 3): see :meth:`simulate_nodes` for the arguments."""
        nodes = self.simulate_nodes(
            control_times,
            control_points,
            frame_times,
            properties=properties,
            progress=progress,
            from_rest=from_rest,
        )
        return self.particles_at(nodes)

    def simulate_nodes(
        self,
        control_times: Array,
        control_points: Array,
        frame_times: Array,
        *,
        properties: Array | None = None,
        progress: Progress | None = None,
        from_rest: bool = False,
    ) -> Array:
        """Integrate under a control track and return the carriers at the frames.

        Args:
            control_times, control_points: (Tc,) [s] and (Tc, K, 3) [m]; first time is the start.
            frame_times: (T,) [s], the first one is the start.
            properties: log factors of stiffness and density, (P, 2), and of the ground's friction, (P, 3), or None;
                they come on top of the twin's own.
            progress: called with (knots done, knots in all); may raise to stop.
            from_rest: start with zero velocity and release at once.

        Returns:
            (T, n, 3) [m]: nodes, or in the updated Lagrangian form the particles, (T, P, 3).

        Raises:
            SimulationError: the run cannot be trusted; the message has the numbers.
            SceneUnsupported: the updated Lagrangian form lacks what acts on this twin.
        """
        run = self.integration(
            control_times, control_points, frame_times, properties=properties, from_rest=from_rest
        )
        return self.carriers(self.solver(run.problem), run, progress)

    def solver(self, problem: Problem, time_step_s: float | None = None) -> Any:
        """A problem as this twin's form, transfer and flow law integrate it.

        Raises what :meth:`physworld.engine.formulations.Formulation.solver` does.
        """
        return self.form.solver(problem, time_step_s, self.transfer, self.plasticity)

    def carriers(self, solver: Any, run: Integration, progress: Progress | None = None) -> Array:
        """Carriers (T, n, 3) [m] at the frames of a run that a solver of this twin integrates. May raise."""
        carriers = self.form.run(solver, self.course(run, run.velocity), progress)
        return run.at_frames(self.carriers_start, carriers)

    def course(self, run: Integration, velocity: Array) -> Course:
        """A run from the first frame on, with nodal velocities (n, 3) [m/s] there."""
        return Course(self.body.start, velocity, self.particles_start, run.held, run.knots)

    @property
    def carriers_start(self) -> Array:
        """Carriers at the first frame [m], (n, 3)."""
        return self.particles_start if self.form.on_particles else self.body.start

    def integration(
        self,
        control_times: Array,
        control_points: Array,
        frame_times: Array,
        *,
        properties: Array | None = None,
        from_rest: bool = False,
    ) -> Integration:
        """What :meth:`simulate_nodes` integrates, for whoever wants to integrate it otherwise: same arguments."""
        properties = together(self.properties, properties)
        stops = np.concatenate([control_times, switch_times(self.openings)])
        knots, frame_index = solver_knots(stops, frame_times, 0.0 if from_rest else self.release_s)
        active = in_order(self.effects)
        for known in active:
            control_times, control_points = known.controls(control_times, control_points)
        controls = PchipInterpolator(control_times, control_points, axis=0)(
            np.clip(knots, control_times[0], control_times[-1])
        )
        problem = Problem(
            lattice=self.lattice,
            law=self.law,
            rest=self.body.rest,
            gravity_m_s2=self.gravity_m_s2,
            drag_per_s=self.air_drag_per_s,
            stiffness_factor=None if properties is None else np.exp(properties[:, 0]),
            density_factor=None if properties is None else np.exp(properties[:, 1]),
            friction_factor=self._friction_factor(properties),
            added_mass=self.body.added_mass,
            terms=(*self.contacts, *self._pushes(control_times, control_points)),
            span_s=(float(knots[0]), float(knots[-1])),
            device=self.device,
        )
        for known in active:
            problem = known.problem(problem, self)
        velocity = np.zeros_like(self.body.start) if from_rest else self.body.start_velocity
        gripped, regions = self.gripped(), soft_regions(self)
        held = held_paths(gripped, knots, controls)
        twists = () if self.natural is not None else twist_between_grips(gripped, knots, controls)
        problem = replace(problem, terms=(*problem.terms, *self._touching_itself(held.nodes), *twists))
        for known in active:
            problem, held = known.attach(problem, held, self)
        # A rest shape that is not the declared one stretches the grips' boxes.
        stretch = problem.lattice.spacing / self.lattice.spacing
        regions = [region * stretch for region in regions]
        problem, held = soften(problem, held, self.grip_softness, regions)
        if self.natural is not None:
            problem = replace(problem, sections=sections_of(gripped, held, knots, controls))
        return Integration(problem, velocity, held, knots, frame_index)

    def gripped(self) -> Twin:
        """The twin whose grips prescribe the motion: as effects have them, and of soft grips all nodes they touch."""
        gripped = self
        for known in in_order(self.effects):
            gripped = known.grips(gripped)
        return with_touched_nodes(gripped, self.body.start) if soft_regions(self) else gripped

    def particles_at(self, nodes: Array) -> Array:
        """Particles (T, P, 3) of the carriers' trajectories (T, n, 3)."""
        if self.form.on_particles:
            return nodes
        return applied(self._particle_rows, nodes)

    def track_nodes(self, nodes: Array) -> Array:
        """Tracked points (T, N, 3) of the carriers' trajectories (T, n, 3), from the first frame on."""
        body, lattice = self.body, self.lattice
        if self.form.on_particles:
            material = lattice.particle_measures > 0
            return follow(lattice.interpolation(body.points) @ body.start, nodes[:, material])
        return material_tracks(body, nodes)

    def observe(self, nodes: Array, times: Array) -> Array:
        """Tracked points (T, N, 3) as the camera reports them: :meth:`track_nodes` and the measurement's effects.

        Args:
            nodes: the carriers' trajectories, (T, n, 3) [m].
            times: their frames, (T,) [s].
        """
        active, followed = in_order(self.effects), self
        for known in active:
            followed = known.followed(followed)
        tracks = followed.track_nodes(nodes)
        for known in active:
            tracks = known.measured(times, tracks, self)
        return tracks

    def track(self, particles: Array) -> Array:
        """Tracked points (T, N, 3) of particle trajectories (T, P, 3), through the nodes that carry them.

        Where a body is one cell thick its particles do not fix the nodes: the smoothest of them are taken. In the
        updated Lagrangian form the particles are the carriers, and the first frame must be the start.
        """
        if self.form.on_particles:
            return self.track_nodes(np.asarray(particles, dtype=float))
        rows, bends = self._particle_rows, self.lattice.second_differences()
        factor = splu((rows.T @ rows + _SMOOTHING * bends.T @ bends).tocsc())
        flat = np.asarray(particles, dtype=float).transpose(1, 0, 2).reshape(rows.shape[0], -1)
        nodes = factor.solve(rows.T @ flat).reshape(rows.shape[1], -1, 3).transpose(1, 0, 2)
        return self.track_nodes(nodes)

    def to_arrays(self) -> dict[str, Array]:
        """Everything as plain arrays, fit for an npz without pickle; :meth:`from_arrays` is the inverse."""
        return arrays_of(self)

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array], device: str | None = None) -> Twin:
        """The twin that :meth:`to_arrays` took apart, to be simulated on ``device``."""
        return cls(**parts_of(arrays), device=device or default_device())

    @property
    def contacts(self) -> tuple[Term, ...]:
        """The ground under the body, as a term; none where no ground is declared."""
        if self.ground_height_m is None:
            return ()
        plane = ground(self.ground_height_m, self.ground_friction)
        offsets: Array | float = 0.0
        if self.lattice.dim < 3:
            offsets = touching(
                self.lattice, self.body.start, plane, self.release_s, self.body.half_thickness_m
            )
        return (GroundContact(self.ground_height_m, self.ground_friction, offsets),)

    def _touching_itself(self, held: Array) -> tuple[Term, ...]:
        """Contact of the body with itself, but for what the grips hold."""
        if self.self_friction is None:
            return ()
        return (SelfContact(2 * self.body.half_thickness_m, self.self_friction, held),)

    def _friction_factor(self, properties: Array | None) -> Array | None:
        if properties is None or properties.shape[1] < 3:
            return None
        if self.ground_height_m is None or not self.form.supports("friction_field"):
            raise SceneUnsupported(
                f"a field of the ground's friction over {len(properties)} particles needs a ground and the total "
                f"Lagrangian form; here the ground is at {self.ground_height_m} and the form {self.formulation}"
            )
        return np.exp(properties[:, 2])

    def _pushes(self, times: Array, points: Array) -> list[Term]:
        """Contacts with the colliders under a control track."""
        terms = []
        for known in self.colliders:
            moving = known.on_its_way(self.controllers_start, times, points)
            terms.append(
                known.contact(
                    moving, self.lattice, self.body.start, self.release_s, self.body.half_thickness_m
                )
            )
        return terms
