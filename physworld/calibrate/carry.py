"""The material of one recording on another of the same object.

What belongs to the object is taken over as it is: law, drag, flow law, fields. What belongs to a recording is its own:
start, grips, ground, colliders. Of a solid that is also when somebody let go of it, and by how much a measured frame is
out of level; both are found on the training frames of the new recording, where these ask for it. Of a discrete rod it
is how it was rolled when it was gripped, which nobody sees: the angle of its first grip about its axis, and by how much
the far grip is rolled beyond that. They turn the natural curvature k0 within the section and add to the natural twist
t0,

    k0'(s) = R(alpha - psi s / L) k0(s)        t0' = t0 - psi / L

and so is its rest shape, which creeps and slips whenever somebody coils, carries or grips it: from the shape that was
carried over it is found anew, with the deviations that a calibration gives a shape of which nothing is known. All of
it is found on the training frames of the new recording, and so is, last, where tracked points lie in the body
(:mod:`physworld.calibrate.places`); nothing else is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.descents import Optimum
from physworld.calibrate.global_stage import free_optional
from physworld.calibrate.parameters import level, release
from physworld.calibrate.places import placed_as_seen
from physworld.calibrate.rod_parameters import SHAPE, rod_parameters
from physworld.calibrate.rod_search import RodSearch
from physworld.calibrate.search import Search
from physworld.effects.gravity_tilt import GravityTilt
from physworld.engine.rods.chain import Chain
from physworld.errors import SceneUnsupported
from physworld.estimation.unknowns import at
from physworld.scene import Scene
from physworld.twin.build import build_twin
from physworld.twin.rods import first_mode, is_pose, shapes
from physworld.twin.twin import Twin

_ROLLS, _FAR_ROLLS = 16, (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)
_DESCENTS, _STEPS, _STEP_RAD = 3, 6, 0.02
_RUNS = 100  # of a solid, for release and level
_EARLY = 0.43  # of the training frames, for the scan
_ROUNDS = 4  # descents, each with what the one before it leaves as the deviation of a residual


def carried_over(twin: Twin, scene: Scene, particle_budget: int = 2000) -> Twin:
    """A twin of ``scene`` with the material of ``twin``, which was calibrated on another recording of the object.

    Args:
        twin: calibrated.
        scene: the other recording.
        particle_budget: about how many particles a solid gets.

    Raises:
        SceneUnsupported: the scene's body is of another dimension, or a rod with other points.
        SimulationError: with that material the training frames cannot be simulated.
    """
    own = build_twin(
        scene, particle_budget, twin.device, plasticity=twin.plasticity, formulation=twin.formulation,
        transfer=twin.transfer,
    )  # fmt: skip
    if own.lattice.dim != twin.lattice.dim:
        raise SceneUnsupported(
            f"a body of dimension {own.lattice.dim} takes no material of one of dimension {twin.lattice.dim}"
        )
    same = twin.properties is not None and len(twin.properties) == len(own.particles_rest)
    taken = replace(
        own,
        law=twin.law,
        air_drag_per_s=twin.air_drag_per_s,
        grip_softness=twin.grip_softness,
        effects=tuple(known for known in twin.effects if known.name != GravityTilt.name),
        properties=twin.properties if same else None,
    )
    if twin.natural is not None:
        found = _shaped_as_seen(_rolled_as_seen(twin, taken, scene), scene)
    else:
        found = _set_up_as_seen(taken, scene)
    nodes = found.simulate_nodes(*scene.control_track(), scene.times[: scene.train[1]])
    return placed_as_seen(scene, found, nodes)


def _set_up_as_seen(own: Twin, scene: Scene) -> Twin:
    """The body with the release and the level of the training frames, where these ask for them."""
    search = Search(scene, own, _RUNS, None, None)
    loose = [*release(own, scene.times[: search.end]), *level(scene, own)]
    if not loose:
        return own
    nothing = np.zeros(0)
    begun = Optimum(nothing, float(np.mean(search.residual([], nothing) ** 2)))
    kept, found, _ = free_optional(search, [], begun, loose)
    return search.at(kept, found.theta)


def _shaped_as_seen(own: Twin, scene: Scene) -> Twin:
    """The rod with the rest shape of the training frames, near the one that it has."""
    shape = []
    for unknown in rod_parameters(scene, own):
        if unknown.name.startswith(SHAPE) and unknown.read is not None and unknown.prior is not None:
            here = unknown.read(own)
            shape.append(replace(unknown, start=here, prior=(here, unknown.prior[1])))
    search = RodSearch(scene, own, 2 * _ROUNDS * (_STEPS + 1))
    place = np.array([unknown.start for unknown in shape])
    for _ in range(_ROUNDS):
        place, _ = search.descend(shape, place, search.end, _STEPS)
        left = _errors(search, [at(own, shape, place)], search.end)[0]
        search.sigma = max(scene.noise_sigma_m or 0.0, float(np.sqrt(left)), 1e-9)
    return at(own, shape, place)


def _rolled_as_seen(twin: Twin, own: Twin, scene: Scene) -> Twin:
    """The rod as it was rolled when the grips took it, by the training frames."""
    lattice = own.lattice
    assert isinstance(lattice, Chain) and isinstance(twin.lattice, Chain)
    if not np.array_equal(lattice.parent, twin.lattice.parent):
        raise SceneUnsupported(
            f"a rod of {len(lattice.parent)} nodes takes no natural curvature of one of {len(twin.lattice.parent)}"
        )
    search = RodSearch(scene, own, 1 + _DESCENTS * 2 * _STEPS)
    loose = len(own.held_nodes) < 2  # a free end has no roll of its own
    early = max(4, round(_EARLY * search.end))
    places = [
        np.array([roll, far])
        for roll in np.linspace(0.0, 2.0 * np.pi, _ROLLS, endpoint=False)
        for far in (_FAR_ROLLS[:1] if loose else _FAR_ROLLS)
    ]
    errors = _errors(search, [_rolled(twin, own, place) for place in places], early)
    best: list[tuple[float, Array]] = []
    for k in np.argsort(errors)[:_DESCENTS]:
        best.append(_descended(search, twin, own, places[k], loose))
    return _rolled(twin, own, min(best, key=lambda found: found[0])[1])


def _errors(search: RodSearch, twins: list[Twin], end: int) -> Array:
    return np.array([np.inf if r is None else float(np.mean(r**2)) for r in search.residuals(twins, end)])


def _descended(search: RodSearch, twin: Twin, own: Twin, place: Array, loose: bool) -> tuple[float, Array]:
    """Gauss-Newton on the two angles over all training frames."""
    free = 1 if loose else 2
    error = float(_errors(search, [_rolled(twin, own, place)], search.end)[0])
    for _ in range(_STEPS):
        probes = [place, *(place + _STEP_RAD * np.eye(2)[k] for k in range(free))]
        now, *there = search.residuals([_rolled(twin, own, p) for p in probes], search.end)
        if now is None or any(r is None for r in there):
            break
        jacobian = np.stack([(r - now) / _STEP_RAD for r in there if r is not None], axis=1)
        step = np.zeros(2)
        step[:free] = -np.linalg.lstsq(jacobian, now, rcond=None)[0]
        trials = [place + share * np.clip(step, -1.0, 1.0) for share in (1.0, 0.3, 0.1)]
        errors = _errors(search, [_rolled(twin, own, t) for t in trials], search.end)
        if not errors.min() < error:
            break
        place, error = trials[int(np.argmin(errors))], float(errors.min())
    return error, place


def _rolled(twin: Twin, own: Twin, place: Array) -> Twin:
    """``own`` with the natural shape of ``twin`` under a roll and a far roll [rad]."""
    lattice = own.lattice
    assert isinstance(lattice, Chain) and twin.natural is not None and own.natural is not None
    first = first_mode(own)
    base = shapes(own)[:, first:]
    smooth = shapes(twin)[:, first_mode(twin) :] @ twin.natural[first_mode(twin) :]
    length = float(lattice.distances.max())
    angle = place[0] - place[1] * lattice.distances / length
    turned = smooth.copy()
    turned[:, :2] = _turn(smooth[:, :2], angle)
    turned[:, 2] -= place[1] / length
    natural = own.natural.copy()
    natural[first:] = np.linalg.lstsq(base[1:], turned[1:], rcond=None)[0]
    for number, group in enumerate(own.controller_groups):
        if is_pose(own.controllers_start[group]):
            natural[number, :2] = _turn(twin.natural[None, number, :2], place[:1])[0]
    return replace(own, natural=natural)


def _turn(vectors: Array, angles: Array) -> Array:
    """Plane vectors (M, 2) turned by angles (M,) [rad]."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], axis=1)
