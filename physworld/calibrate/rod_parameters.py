"""What a calibration of a discrete rod searches: every number with its prior, and what drives a rod from inside.

Priors: curvature of its own as of a cable that was coiled, torsion of a round section, air drag of ropes and foam rods
in air, friction and creep small. Stiffness is scaled by the rod's weight: rho A g L^3.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter
from physworld.engine.rods.chain import Chain
from physworld.estimation.unknowns import LINEAR, LOG
from physworld.materials.cable import CableLaw
from physworld.scene import Scene
from physworld.twin.rods import first_mode, is_pose, natural_of
from physworld.twin.twin import Twin

GRAVITY = 9.81
DRIVE = "drive_"
"""How the names of what drives a rod begin."""
SHAPE = ("curvature_", "natural_twist", "grip_angle_")
"""How the names of a rod's rest shape begin."""
LOSSES = (
    "relaxation_s", "air_drag_per_s", "drag_normal_per_m", "friction_per_m", "friction_onset_per_m", "creep_ratio",
    "creep_s",
)  # fmt: skip
"""Numbers by which a rod loses energy."""
_LOSSLESS = {name: 0.0 for name in LOSSES if name not in ("friction_onset_per_m", "creep_s")}
_GRIP_RAD, _BRANCH_RAD = 0.5, 0.3
_COIL = 4.0  # curvature of its own times the length, of the smoothest shape: a cable that was coiled
_STEP_S, _REST_S = 0.1, 0.3  # in which a step that is driven from inside shows, and of the rest before it
_QUIET, _GOES = 0.05, 0.2  # shares of how far the points go in all
_ONSET_S, _RISE_S = 0.05, 0.06


def rod_parameters(scene: Scene, twin: Twin) -> list[Parameter]:
    """Everything of a discrete rod that is searched, with its prior."""
    lattice, law = twin.lattice, twin.law
    assert isinstance(lattice, Chain) and isinstance(law, CableLaw) and twin.natural is not None
    length = float(lattice.distances.max())
    weight = law.density * GRAVITY * length**3
    slow = float(np.sqrt(length))
    found = [
        _number("bending_n_m2", "N m^2", 1e-2 * weight, 2.5, 0.05),
        _number("relaxation_s", "s", 0.02 * slow, 1.5),
        _number("air_drag_per_s", "1/s", 0.1, 1.5),
        _number("drag_normal_per_m", "1/m", 0.1, 1.5),
        _number("stretching_n", "N", law.stretching_n, 1.0),
        _number("torsion_ratio", "1", law.torsion_ratio, 0.5),
        _number("friction_per_m", "1/m", 0.3 / length, 1.5),
        _number("friction_onset_per_m", "1/m", 1.0 / length, 1.0),
        _number("creep_ratio", "1", 0.1, 1.5),
        _number("creep_s", "s", 1.5, 1.0),
    ]
    for row in range(len(twin.held_nodes)):
        if is_pose(twin.controllers_start[twin.controller_groups[row]]):
            found += [
                _natural(twin, row, axis, f"grip_angle_{row}_{axis}", "rad", _GRIP_RAD) for axis in range(2)
            ]
    for number in range(len(lattice.branches)):
        row = len(twin.held_nodes) + number
        found += [
            _natural(twin, row, axis, f"branch_{number}_angle_{axis}", "rad", _BRANCH_RAD)
            for axis in range(2)
        ]
    for mode, row in enumerate(range(first_mode(twin), len(twin.natural))):
        spread = _COIL / (length * (1 + mode))
        found += [_natural(twin, row, axis, f"curvature_{mode}_{axis}", "1/m", spread) for axis in range(2)]
    found.append(_natural(twin, first_mode(twin), 2, "natural_twist", "1/m", 1.0 / length))
    found += [u for step in range(len(_steps(twin))) for u in _driven(twin, step, length)]
    for number, particles in enumerate(_branches(lattice)):
        found += [
            _branch(number, particles, 0, "stiffness", 2.0, len(twin.particles_rest)),
            _branch(number, particles, 1, "density", 0.5, len(twin.particles_rest)),
        ]
    return found


def lossless(twin: Twin) -> Twin:
    """The twin of a rope or rod without friction, drag and creep."""
    return twin.with_parameters(**{n: v for n, v in _LOSSLESS.items() if n in twin.parameters})


def steps_seen(scene: Scene) -> Array | None:
    """Steps of a body that moves by itself, (J, 6), when they begin and which of them vent; None where there are none.

    Its base stands still, it starts at rest, and then, out of rest, its points go far within a tenth of a second. A
    step after which they are about where they began vents: what drove them is gone.
    """
    end = scene.train[1]
    times, moved = scene.times[:end], scene.controllers[:end] - scene.controllers[0]
    seen = scene.visible[:end].all(axis=1)
    if np.abs(moved).max(initial=0.0) > 0.0 or seen.sum() < 4:
        return None
    path = scene.points[:end][seen].mean(axis=1)
    times = times[seen]
    spread = float(np.linalg.norm(path - path[0], axis=1).max())
    found: list[float] = []
    for k in range(len(times)):
        if times[k] < times[0] + _STEP_S:
            continue
        before, after = np.searchsorted(times, [times[k] - _REST_S, times[k] + _STEP_S])
        after = min(after, len(times) - 1)
        quiet = np.linalg.norm(path[before : k + 1] - path[k], axis=1).max() < _QUIET * spread
        goes = np.linalg.norm(path[after] - path[k]) > _GOES * spread
        if quiet and goes:
            if found and times[k] - found[-1] <= 2.0 * _STEP_S:
                found.pop()  # the last quiet moment is the one
            found.append(float(times[k]))
    if not found:
        return None
    drive = np.zeros((len(found), 6))
    drive[:, 0], drive[:, 1] = found, _RISE_S
    for row, (begin, until) in enumerate(pairwise([*found, float(times[-1]) + 2.0 * _STEP_S])):
        after = path[(times > begin + _STEP_S) & (times < until - _STEP_S)]
        drive[row, 5] = len(after) > 0 and np.linalg.norm(after.mean(axis=0) - path[0]) < _GOES * spread
    return drive


def _number(name: str, unit: str, mean: float, spread: float, step: float = 0.02) -> Parameter:
    """A positive number with a log-normal prior."""
    low, high = mean * np.exp(-4.0 * spread), mean * np.exp(4.0 * spread)
    return Parameter(
        name, unit, low, high, lambda twin, value: twin.with_parameters(**{name: value}),
        transform=LOG, step=step, start=float(np.log(mean)), prior=(float(np.log(mean)), spread), starts=(mean,),
        stage="optional", read=lambda twin: twin.parameters[name],
    )  # fmt: skip


def _natural(twin: Twin, row: int, column: int, name: str, unit: str, spread: float) -> Parameter:
    """An amplitude of the natural curvature or twist with a Gaussian prior about a rod that is straight at rest."""
    known = natural_of(twin.body, len(twin.held_nodes))
    assert known is not None
    mean = float(known[row, column])

    def apply(twin: Twin, value: float) -> Twin:
        assert twin.natural is not None
        natural = twin.natural.copy()
        natural[row, column] = value
        return replace(twin, natural=natural)

    def read(twin: Twin) -> float:
        assert twin.natural is not None
        return float(twin.natural[row, column])

    return Parameter(
        name, unit, mean - 5.0 * spread, mean + 5.0 * spread, apply, transform=LINEAR, step=0.05 * spread,
        start=mean, prior=(mean, spread), starts=(mean,), stage="optional", read=read,
    )  # fmt: skip


def _driven(twin: Twin, step: int, length: float) -> list[Parameter]:
    """A step of what drives a rod from inside: when, how fast, and how far; one that vents goes back to nothing."""
    begin, vents = float(_steps(twin)[step, 0]), bool(_vents(_steps(twin))[step])
    numbers = [
        (0, f"{DRIVE}{step}_s", "s", begin, _ONSET_S, LINEAR, 0.002),
        (1, f"{DRIVE}{step}_rise_s", "s", _RISE_S, 1.0, LOG, 0.05),
        (2, f"{DRIVE}{step}_curvature_0", "1/m", 0.0, _COIL / length, LINEAR, 0.01 / length),
        (3, f"{DRIVE}{step}_curvature_1", "1/m", 0.0, _COIL / length, LINEAR, 0.01 / length),
        (4, f"{DRIVE}{step}_stretch", "1", 0.0, 0.05, LINEAR, 1e-3),
    ]  # fmt: skip
    found = []
    for column, name, unit, mean, spread, transform, difference in numbers[: 2 if vents else None]:

        def apply(changed: Twin, value: float, column: int = column) -> Twin:
            drive = _steps(changed).copy()
            drive[step, column] = value
            for row in np.flatnonzero(_vents(drive)):
                drive[row, 2:5] = -drive[:row, 2:5].sum(axis=0)
            return replace(changed, drive=drive)

        def read(changed: Twin, column: int = column) -> float:
            return float(_steps(changed)[step, column])

        start = transform.searched(mean)
        ends = start - 5.0 * spread, start + 5.0 * spread
        found.append(
            Parameter(
                name, unit, transform.value(ends[0]), transform.value(ends[1]), apply, transform=transform,
                step=difference, start=start, prior=(start, spread), starts=(mean,), stage="optional",
                read=read,
            )
        )  # fmt: skip
    return found


def _steps(twin: Twin) -> Array:
    return np.zeros((0, 6)) if twin.drive is None else twin.drive


def _vents(drive: Array) -> Array:
    """Which steps (J, 6) go back to nothing."""
    vents: Array = drive[:, 5] > 0.0
    return vents


def _branches(lattice: Chain) -> list[Array]:
    """Particles of every branch of a cable: what does not lie on its way from the first node to the longest end."""
    edges = np.arange(1, len(lattice.parent))
    new = [int(e) for e in edges if lattice.parent[e] != e - 1]
    ends = [*new[1:], len(lattice.parent)] if new else []
    return [
        np.concatenate([[2 * (e - 1), 2 * (e - 1) + 1] for e in range(begin, end)])
        for begin, end in zip(new, ends, strict=True)
    ]


def _branch(number: int, particles: Array, column: int, what: str, spread: float, count: int) -> Parameter:
    """The stiffness or density of a branch over the cable's, with a log-normal prior."""

    def apply(twin: Twin, value: float) -> Twin:
        properties = np.zeros((count, 2)) if twin.properties is None else twin.properties.copy()
        properties[particles, column] = np.log(value)
        return replace(twin, properties=properties)

    return Parameter(
        f"branch_{number}_{what}", "1", np.exp(-4 * spread), np.exp(4 * spread), apply, transform=LOG, step=0.05,
        prior=(0.0, spread), starts=(1.0,), stage="optional",
        read=lambda twin: 1.0 if twin.properties is None else np.exp(twin.properties[particles[0], column]),
    )  # fmt: skip
