"""Verification of solids: free fall, waves, clamped bars, patch tests, friction, numerical damping."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from benchmarks.verification.cases import (
    CLAMP_REACH,
    GRAVITY,
    Case,
    clamped_lattice,
    gripped,
    hold,
    nowhere,
    path,
    rest_nodes,
    ringing,
    run,
)
from physworld.devices import default_device
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import Problem, nodal_mass
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.solid import SolidLaw

_ON: dict[str, Any] = {"device": default_device()}
LENGTH, DEPTH = 0.3, 0.03
STIFF = NeoHookean(2e6, 0.0, density_kg_m3=600.0)
CLAMPED_FREE = 1.8751040687  # first root of cos x cosh x = -1
SQUARE_TORSION = 0.1405770  # J / a^4 of a square section (Saint-Venant)
SILICONE = NeoHookean(
    2.64e5, 0.45, density_kg_m3=1070.0
)  # the beam of shared/data/real/beam_free_a, as its source fits it
SILICONE_SIZE = (0.1, 0.03, 0.03)


def free_fall(step: float) -> float:
    """Worst distance from the parabola after 0.5 s over the fall, with ``step`` times the default time step."""
    lattice = box_lattice(np.zeros(3), np.full(3, 0.06), (2, 2, 2))
    law = NeoHookean(1e5, 0.3)
    rest = rest_nodes(lattice)
    velocity = np.tile([0.4, 0.0, 1.0], (len(rest), 1))
    times = np.linspace(0.0, 0.5, 6)
    dt = step * TotalLagrangian(Problem(lattice, law, rest, GRAVITY)).time_step_s
    nodes = run(lattice, law, times, nowhere(), velocity=velocity, time_step_s=dt)
    exact = rest + times[:, None, None] * velocity + 0.5 * times[:, None, None] ** 2 * GRAVITY
    return float(np.abs(nodes - exact).max() / (0.5 * 9.81 * 0.5**2))


def bar_wave(cells: float) -> float:
    """L2 error of a pulse that runs a third of a free bar (nu = 0), over its norm; d'Alembert's solution."""
    _, moved, exact, _ = _pulse_run(cells, 601)
    return float(np.linalg.norm(moved[1] - exact) / np.linalg.norm(exact))


def bar_wave_speed(cells: float) -> float:
    """Relative error of the speed of that pulse: the shift at which it correlates best with itself, over the time."""
    probe, moved, _, time = _pulse_run(cells, 6001)
    correlation = np.correlate(moved[1], moved[0], mode="full")
    peak = int(np.argmax(correlation))
    left, middle, right = correlation[peak - 1 : peak + 2]
    shift = peak + 0.5 * (left - right) / (left - 2 * middle + right) - (len(probe) - 1)
    return float(shift * (probe[1] - probe[0]) / time / np.sqrt(2e6 / 600.0) - 1)


def _pulse_run(cells: float, probes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Places (k,) along the bar, displacements there at start and end (2, k), the exact ones at the end, the time."""
    count, speed, width, size = int(cells), np.sqrt(2e6 / 600.0), 0.03, 1e-5
    length = 0.6
    lattice = box_lattice(np.zeros(3), np.array([length, 0.03, 0.03]), (count, 2, 2))
    rest = rest_nodes(lattice)

    def pulse(x: np.ndarray) -> np.ndarray:
        return size * np.exp(-(((x - length / 3) / width) ** 2))

    # splines approximate: nodal values that reproduce a pulse at order 4 take off dx^2/8 of its curvature
    dx = float(lattice.spacing[0])
    x = rest[:, 0]
    curvature = (4 * ((x - length / 3) / width) ** 2 - 2) / width**2 * pulse(x)
    start = rest.copy()
    start[:, 0] += pulse(x) - dx**2 / 8 * curvature
    velocity = np.zeros_like(rest)
    slope = -2 * (x - length / 3) / width**2 * pulse(x)
    velocity[:, 0] = -speed * slope
    time = length / 3 / speed
    nodes = run(
        lattice, STIFF, np.array([0.0, time]), nowhere(), gravity=np.zeros(3), start=start, velocity=velocity
    )
    probe = np.linspace(0.0, length, probes)
    where = np.stack([probe, np.full_like(probe, 0.015), np.full_like(probe, 0.015)], axis=1)
    moved = (lattice.interpolation(where) @ (nodes - rest)[:, :, 0].T).T
    return probe, moved, pulse(probe - speed * time), time


def _clamped(cells: float, reach: float, law: SolidLaw = STIFF) -> tuple[Lattice, np.ndarray]:
    count = int(cells)
    across = max(1, count // 10)
    lattice = clamped_lattice(LENGTH, (DEPTH, DEPTH), (count, across, across), reach)
    return lattice, gripped(lattice)


def axial_frequency(cells: float, reach: float = CLAMP_REACH) -> float:
    """Relative error of the first axial frequency of a clamped bar, c / 4 L, nu = 0."""
    lattice, held = _clamped(cells, reach)
    rest = rest_nodes(lattice)
    exact = 0.5 * np.pi * np.sqrt(2e6 / 600.0) / LENGTH
    velocity = np.zeros_like(rest)
    velocity[:, 0] = 1e-3 * np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, LENGTH) / LENGTH)
    times = np.linspace(0.0, 4 * 2 * np.pi / exact, 200)
    nodes = run(lattice, STIFF, times, held, gravity=np.zeros(3), velocity=velocity)
    tip = path(lattice, nodes, (LENGTH, DEPTH / 2, DEPTH / 2))[:, 0] - LENGTH
    return ringing(times, tip, exact)[1] / exact - 1


def timoshenko_frequency(
    length: float, depth: float, modulus: float, shear: float, density: float, shape: float = 5 / 6
) -> float:
    """First angular frequency [rad/s] of a clamped-free Timoshenko beam of square section ``depth``.

    Roots of the frequency equation after Huang 1961; ``shape`` is the shear coefficient.
    """
    area, inertia = depth**2, depth**4 / 12
    r2 = inertia / (area * length**2)
    s2 = modulus * inertia / (shape * area * shear * length**2)

    def equation(omega: float) -> float:
        b2 = density * area * length**4 / (modulus * inertia) * omega**2
        root = np.sqrt((r2 - s2) ** 2 + 4 / b2)
        b = np.sqrt(b2)
        a1, a2 = np.sqrt(0.5 * (-(r2 + s2) + root)), np.sqrt(0.5 * (r2 + s2 + root))
        return float(
            2
            + (b2 * (r2 - s2) ** 2 + 2) * np.cosh(b * a1) * np.cos(b * a2)
            - b * (r2 + s2) / np.sqrt(1 - b2 * r2 * s2) * np.sinh(b * a1) * np.sin(b * a2)
        )

    euler = CLAMPED_FREE**2 * np.sqrt(modulus * inertia / (density * area * length**4))
    return float(brentq(equation, 0.5 * euler, 1.02 * euler))


def bending_run(cells: float, reach: float, law: SolidLaw = STIFF) -> tuple[float, float]:
    """Angular frequency [rad/s] and decay rate [1/s] of the first bending mode of the clamped bar, small swings."""
    lattice, held = _clamped(cells, reach, law)
    rest = rest_nodes(lattice)
    guess = CLAMPED_FREE**2 * np.sqrt(law.youngs_modulus_pa * DEPTH**2 / 12 / law.density_kg_m3) / LENGTH**2
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.02 * bending_mode(np.clip(rest[:, 0] / LENGTH, 0, None))
    times = np.linspace(0.0, 4 * 2 * np.pi / guess, 160)
    nodes = run(lattice, law, times, held, gravity=np.zeros(3), velocity=velocity)
    tip = path(lattice, nodes, (LENGTH, DEPTH / 2, DEPTH / 2))[:, 2] - DEPTH / 2
    _, frequency, rate = ringing(times, tip, guess)
    return frequency, rate


def bending_mode(s: np.ndarray) -> np.ndarray:
    """First mode of a clamped-free Euler-Bernoulli beam at s = x / L, 1 at the tip."""
    k = CLAMPED_FREE
    ratio = (np.cosh(k) + np.cos(k)) / (np.sinh(k) + np.sin(k))
    return 0.5 * (np.cosh(k * s) - np.cos(k * s) - ratio * (np.sinh(k * s) - np.sin(k * s)))


def bending_frequency(cells: float, reach: float = CLAMP_REACH) -> float:
    """Relative error of the first bending frequency of a clamped bar (nu = 0) against Timoshenko's beam."""
    law = STIFF
    exact = timoshenko_frequency(LENGTH, DEPTH, law.youngs_modulus_pa, law.lame[0], law.density_kg_m3)
    return bending_run(cells, reach)[0] / exact - 1


def static_sag(cells: float, reach: float = CLAMP_REACH) -> float:
    """Relative error of the sag under a weak gravity against Timoshenko's beam, w L^4 / 8 E I + w L^2 / 2 k G A."""
    lattice, held = _clamped(cells, reach)
    gravity = GRAVITY * 0.2
    load = STIFF.density_kg_m3 * DEPTH**2 * 0.2 * 9.81
    bending = load * LENGTH**4 / (8 * STIFF.youngs_modulus_pa * DEPTH**4 / 12)
    shear = load * LENGTH**2 / (2 * 5 / 6 * STIFF.lame[0] * DEPTH**2)
    frequency = CLAMPED_FREE**2 * np.sqrt(STIFF.youngs_modulus_pa * DEPTH**2 / 12 / 600.0) / LENGTH**2
    times = np.linspace(0.0, 14.0 / frequency, 15)
    nodes = run(lattice, STIFF, times, held, gravity=gravity, drag_per_s=2 * frequency)
    sag = DEPTH / 2 - path(lattice, nodes, (LENGTH, DEPTH / 2, DEPTH / 2))[-1, 2]
    return float(sag / (bending + shear) - 1)


def torsion_frequency(cells: float) -> float:
    """Relative error of the first torsional frequency of a clamped square bar, (1 / 4 L) sqrt(G J / rho Ip)."""
    lattice, held = _clamped(cells, CLAMP_REACH)
    rest = rest_nodes(lattice)
    speed = np.sqrt(STIFF.lame[0] * SQUARE_TORSION / (STIFF.density_kg_m3 / 6))
    exact = 0.5 * np.pi * speed / LENGTH
    angle = 0.5 * np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, LENGTH) / LENGTH)
    velocity = np.zeros_like(rest)
    velocity[:, 1], velocity[:, 2] = -angle * (rest[:, 2] - DEPTH / 2), angle * (rest[:, 1] - DEPTH / 2)
    times = np.linspace(0.0, 4 * 2 * np.pi / exact, 160)
    nodes = run(lattice, STIFF, times, held, gravity=np.zeros(3), velocity=velocity)
    corner = path(lattice, nodes, (LENGTH, DEPTH, DEPTH / 2))[:, 2] - DEPTH / 2
    return ringing(times, corner, exact)[1] / exact - 1


def rotation_patch(cells: float) -> float:
    """Largest force on an inner node of a uniformly stretched, sheared and turned block, over a face's force."""
    count = int(cells)
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.06, 0.06]), (2 * count, count, count))
    rest = rest_nodes(lattice)
    stretch = np.array([[1.2, 0.1, 0.0], [0.1, 0.9, -0.05], [0.0, -0.05, 1.1]])
    deformed = Rotation.from_rotvec([1.1, -2.0, 0.7]).apply(rest @ stretch) + np.array([3.0, -1.0, 2.0])
    force = internal_forces(lattice, NeoHookean(1e5, 0.35), deformed)
    inner = np.bincount(lattice.cell_nodes.ravel(), minlength=len(rest)) == 27
    return float(np.abs(force[inner]).max() / np.abs(force[~inner]).max())


def twist_patch(cells: float) -> float:
    """Largest force on an inner node of a bar twisted by 0.8 rad between its ends, over one on its surface.

    Every section turns by its share of the angle, u = theta(x) x r: a field that quadratic splines hold exactly, and in
    which shear alone carries the twist. Forces even in the angle, which shorten the bar, are taken out by twisting it
    both ways.
    """
    angle, count = 0.8, int(cells)
    length = 0.12
    lattice = box_lattice(np.zeros(3), np.array([length, 0.06, 0.06]), (2 * count, count, count))
    rest = rest_nodes(lattice)
    arm = rest - [0.0, 0.03, 0.03]
    force = np.zeros_like(rest)
    for sign in (1.0, -1.0):
        turned = rest.copy()
        share = sign * angle * rest[:, 0] / length
        turned[:, 1] -= share * arm[:, 2]
        turned[:, 2] += share * arm[:, 1]
        force += sign * internal_forces(lattice, NeoHookean(1e5, 0.35), turned)
    inner = np.bincount(lattice.cell_nodes.ravel(), minlength=len(rest)) == 27
    return float(np.abs(force[inner]).max() / np.abs(force[~inner]).max())


def internal_forces(lattice: Lattice, law: SolidLaw, x: np.ndarray) -> np.ndarray:
    """Internal forces (n, 3) [N] at nodal positions ``x`` (n, 3)."""
    forces = InternalForces(lattice, law, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    out = wp.zeros(x.size, dtype=wp.float64, **_ON)
    forces.launch(
        wp.array(x.reshape(-1), dtype=wp.float64, **_ON),
        wp.zeros(3, dtype=wp.float64, **_ON),
        out,
    )
    return out.numpy().reshape(-1, 3)


def spin(step: float) -> float:
    """Change of a free body's angular momentum over three turns, over its size, at ``step`` default time steps."""
    law = NeoHookean(2e5, 0.3)
    lattice = box_lattice(np.full(3, -0.03), np.array([0.12, 0.06, 0.06]), (4, 2, 2))
    rest = rest_nodes(lattice)
    mass = nodal_mass(lattice, law, None)
    arm = rest - mass @ rest / mass.sum()
    turn = 2 * np.pi * np.array([0.0, 0.0, 3.0])
    velocity = np.cross(turn, arm)
    times = np.concatenate([[0.0, 1e-4], np.linspace(1.0 - 2e-4, 1.0, 3)])
    dt = step * TotalLagrangian(Problem(lattice, law, rest, np.zeros(3))).time_step_s
    nodes = run(lattice, law, times, nowhere(), gravity=np.zeros(3), velocity=velocity, time_step_s=dt)
    late = (nodes[-1] - nodes[-3]) / (times[-1] - times[-3])
    at = nodes[-2] - mass @ nodes[-2] / mass.sum()
    before = np.einsum("n,ni->i", mass, np.cross(arm, velocity))
    after = np.einsum("n,ni->i", mass, np.cross(at, late))
    return float(after[2] / before[2] - 1)


def sliding_block(cells: float) -> float:
    """Relative error of the way that a sliding block takes to stop, v^2 / 2 mu g."""
    count = int(cells)
    law = NeoHookean(2e5, 0.3, viscosity_pa_s=20.0, density_kg_m3=500.0)
    lattice = box_lattice(
        np.zeros(3), np.array([0.12, 0.12, 0.03]), (2 * count, 2 * count, max(1, count // 2))
    )
    friction, speed = 0.4, 0.8
    rest = rest_nodes(lattice)
    depth = 500.0 * 9.81 * 0.03 / ((law.lame[1] + 2 * law.lame[0]) / lattice.spacing.min())
    start = rest - np.array([0.0, 0.0, depth])  # the ground already carries it
    velocity = np.tile([speed, 0.0, 0.0], (len(rest), 1))
    ground = GroundContact(0.0, friction)
    times = np.linspace(0.0, 0.6, 13)
    nodes = run(lattice, law, times, nowhere(), start=start, velocity=velocity, terms=(ground,))
    middle = path(lattice, nodes, (0.06, 0.06, 0.015))[:, 0]
    return float((middle[-1] - middle[0]) / (speed**2 / (2 * friction * 9.81)) - 1)


def silicone_damping(step: float) -> float:
    """Numerical damping ratio of the first bending mode of the silicone beam at its default lattice.

    The beam (0.1 x 0.03 x 0.03 m, clamped at its end, 13 x 4 x 4 cells) is let go from level and swings freely; the
    energy lost by the scheme over twice the time integral of the kinetic energy is the equivalent drag c, the ratio
    c / 2 omega. ``step`` is the share of the default time step.
    """
    lattice = clamped_lattice(SILICONE_SIZE[0], SILICONE_SIZE[1:], (13, 4, 4), CLAMP_REACH)
    rest = rest_nodes(lattice)
    problem = Problem(lattice, SILICONE, rest, GRAVITY)
    dt = step * TotalLagrangian(problem).time_step_s
    times = np.arange(0.0, 1.2, 0.005)
    nodes, ledger = run_with_ledger(
        problem, rest, np.zeros_like(rest), hold(gripped(lattice), rest, len(times)), times, time_step_s=dt
    )
    tip = path(lattice, nodes, (SILICONE_SIZE[0], 0.015, 0.015))[:, 2]
    frequency = ringing(times, tip, 2 * np.pi * 7.5)[1]
    drag = ledger.lost[-1] / (2 * np.trapezoid(ledger.kinetic, times))
    return float(drag / (2 * frequency))


def silicone_decay(step: float) -> float:
    """Damping ratio of the silicone beam's first bending mode by the decay of its amplitude, small swings."""
    lattice = clamped_lattice(SILICONE_SIZE[0], SILICONE_SIZE[1:], (13, 4, 4), CLAMP_REACH)
    rest = rest_nodes(lattice)
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.01 * bending_mode(np.clip(rest[:, 0] / SILICONE_SIZE[0], 0, None))
    dt = step * TotalLagrangian(Problem(lattice, SILICONE, rest, GRAVITY)).time_step_s
    times = np.arange(0.0, 1.5, 0.005)
    nodes = run(
        lattice, SILICONE, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity, time_step_s=dt
    )
    _, frequency, rate = ringing(times, path(lattice, nodes, (0.1, 0.015, 0.015))[:, 2], 2 * np.pi * 7.3)
    return rate / frequency


CASES = (
    Case("free_fall", "free fall, 0.5 s: worst place", "x0 + v0 t + g t²/2", "dt", (1.0, 0.5, 0.25), free_fall,
         1e-9, size=float),
    Case("bar_wave", "pulse along a bar: L2 error after one length of travel", "d'Alembert, c = √(E/ρ)", "dx",
         (60, 120, 240), bar_wave, 0.02, 1.7),
    Case("bar_wave_speed", "pulse along a bar: speed, by its correlation with itself", "√(E/ρ)", "dx",
         (60, 120, 240), bar_wave_speed, 3e-3, 1.7),
    Case("axial_frequency", "clamped bar, axial frequency", "c / 4L", "dx", (10, 20, 40), axial_frequency,
         1e-3, 1.7),
    Case("bending_frequency", "clamped bar, bending frequency", "Timoshenko", "dx", (10, 20, 40),
         bending_frequency, 5e-3, 1.5, exact=False),
    Case("axial_frequency_old_clamp", "axial frequency, cell face on the clamp", "c / 4L", "dx", (10, 20, 40),
         lambda n: axial_frequency(n, 0.0), 0.01, 0.8),
    Case("bending_frequency_old_clamp", "bending frequency, cell face on the clamp", "Timoshenko", "dx",
         (10, 20, 40), lambda n: bending_frequency(n, 0.0), 0.02, 0.7, exact=False),
    Case("static_sag", "clamped bar, sag under weak gravity", "Timoshenko", "dx", (10, 20, 40), static_sag,
         0.01, 1.5, exact=False),
    Case("torsion_frequency", "clamped square bar, torsional frequency", "Saint-Venant", "dx", (20, 40, 80),
         torsion_frequency, 0.03, 1.6),
    Case("rotation_patch", "stretch, shear and turn by 2.4 rad: force inside over force outside", "0", "dx",
         (3, 6), rotation_patch, 1e-4, no_order="single precision"),
    Case("twist_patch", "bar twisted by 0.8 rad: force inside over force outside", "0", "dx", (3, 6), twist_patch, 1e-4,
         no_order="single precision"),
    Case("spin", "free spin, three turns: angular momentum", "conserved", "dt", (1.0, 0.5), spin, 1e-3,
         size=float, no_order="single precision"),
    Case("sliding_block", "sliding block: way to a stop", "v² / 2μg", "dx", (2, 4, 8), sliding_block, 0.02,
         no_order="errors of both signs"),
    Case("silicone_damping", "silicone beam let go from level: numerical damping ratio, by energy", "0", "dt",
         (1.0, 0.5, 0.25), silicone_damping, 2e-3, size=float, no_order="below 1e-6"),
    Case("silicone_decay", "silicone beam, small swings: numerical damping ratio, by amplitude", "0", "dt",
         (1.0, 0.5, 0.25), silicone_decay, 2e-3, size=float, no_order="noise of the fit"),
)  # fmt: skip
