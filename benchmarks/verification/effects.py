"""Verification of effects: drag, internal friction, tilted gravity and lag against their closed forms."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.verification.cases import (
    CLAMP_REACH,
    Case,
    clamped_lattice,
    gripped,
    path,
    rest_nodes,
    ringing,
    run,
)
from physworld.effects.registry import effect
from physworld.engine.problem import Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SIDE = 0.06
DRAG_PER_S = 1.7
TILT_RAD = (0.05, -0.03)
LAG_S = 0.03


def _cube(frames: int, duration: float, gripped_low: bool = False) -> Scene:
    """A small cube in free flight, or held at its low end by four controllers."""
    high = np.array([0.15, SIDE, SIDE]) if gripped_low else np.full(3, SIDE)
    corners = np.array([[0.0, y, z] for y in (0.0, SIDE) for z in (0.0, SIDE)])
    controllers = np.repeat(corners[None], frames, axis=0) if gripped_low else np.zeros((frames, 0, 3))
    points = np.array([[0.01, SIDE / 2, SIDE / 2]]) if gripped_low else high[None] / 2
    return Scene(
        name="cube",
        kind="block",
        points=np.repeat(points[None], frames, axis=0),
        visible=np.ones((frames, 1), dtype=bool),
        controllers=controllers,
        times=np.linspace(0.0, duration, frames),
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=None,
        train=(0, frames - 1),
        test=(frames - 1, frames),
        initial_state=UNDEFORMED_AT_REST,
        body=Body(size_m=high, box_min_m=np.zeros(3), box_max_m=high, density_kg_m3=500.0),
        grips=(Grip((0, 1, 2, 3), np.zeros(3), np.array([0.04, SIDE, SIDE])),) if gripped_low else (),
    )


def _flight(twin: Twin, scene: Scene) -> np.ndarray:
    """Way (T, 3) of the tracked point."""
    track = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)[:, 0]
    return track - track[0]


def drag(step: float) -> float:
    """Error of a fall with linear drag after 0.6 s, over its depth: g t / c - g (1 - exp(-c t)) / c^2."""
    scene = _cube(7, 0.6)
    twin = build_twin(scene, 64).with_effect(effect("air_drag_linear", rate_per_s=DRAG_PER_S))
    run_of = twin.integration(*scene.control_track(), scene.times)
    dt = step * TotalLagrangian(run_of.problem).time_step_s
    nodes = TotalLagrangian(run_of.problem, dt).run(
        twin.body.start, run_of.velocity, run_of.held, run_of.knots
    )
    fallen = -(nodes - nodes[0]).mean(axis=1)[:, 2]
    c, t = DRAG_PER_S, scene.times
    exact = 9.81 * (t / c - (1 - np.exp(-c * t)) / c**2)
    return float(np.abs(fallen - exact).max() / exact[-1])


def tilt(budget: float) -> float:
    """Error of a fall under tilted gravity, over its depth."""
    scene = _cube(7, 0.6)
    twin = build_twin(scene, int(budget)).with_effect(
        effect("gravity_tilt", tilt_x_rad=TILT_RAD[0], tilt_y_rad=TILT_RAD[1])
    )
    gravity = Rotation.from_rotvec([*TILT_RAD, 0.0]).apply([0.0, 0.0, -9.81])
    exact = 0.5 * scene.times[:, None] ** 2 * gravity
    return float(np.abs(_flight(twin, scene) - exact).max() / np.abs(exact).max())


def lag(frames: float) -> float:
    """Error of a gripped point under an actuation lag, over its way; the grip swings at 1 Hz, in ``frames`` samples."""
    count = int(frames)
    scene = _cube(count, 1.5, gripped_low=True)

    def swing(t: np.ndarray) -> np.ndarray:
        return np.where(t > 0, 0.05 * (1 - np.cos(2 * np.pi * t)), 0.0)

    controllers = scene.controllers.copy()
    controllers[:, :, 1] += swing(scene.times)[:, None]
    twin = build_twin(scene, 100).with_effect(effect("actuation_lag", lag_s=LAG_S))
    track = twin.observe(twin.simulate_nodes(scene.times, controllers, scene.times), scene.times)[:, 0]
    return float(np.abs(track[:, 1] - track[0, 1] - swing(scene.times - LAG_S)).max() / 0.1)


def viscosity(cells: float) -> float:
    """Relative error of the decay of axial vibration under Kelvin-Voigt friction, rate eta omega^2 / E at nu = 0."""
    modulus, eta, length, depth = 2e5, 30.0, 0.3, 0.03
    law = NeoHookean(modulus, 0.0, viscosity_pa_s=eta, density_kg_m3=600.0)
    lattice = clamped_lattice(length, (depth, depth), (int(cells), 2, 2), CLAMP_REACH)
    rest = rest_nodes(lattice)
    frequency = 0.5 * np.pi * np.sqrt(modulus / 600.0) / length
    velocity = np.zeros_like(rest)
    velocity[:, 0] = 1e-3 * np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, length) / length)
    times = np.linspace(0.0, 6 * 2 * np.pi / frequency, 300)
    nodes = run(lattice, law, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity)
    rate = ringing(times, path(lattice, nodes, (length, depth / 2, depth / 2))[:, 0], frequency)[2]
    return rate / (eta * frequency**2 / modulus) - 1


def strong_viscosity(cells: float) -> float:
    """Largest error of a bar's end after a push, over its way; explicit friction would want a tenth of the step."""
    return _pushed_bar(cells, 500.0)


def creeping_viscosity(cells: float) -> float:
    """The same at a hundred times: the bar creeps back."""
    return _pushed_bar(cells, 5000.0)


def _pushed_bar(cells: float, eta: float) -> float:
    """Kelvin-Voigt bar at nu = 0: every mode is an oscillator of damping ratio eta omega / E, the first is pushed."""
    modulus, length, depth = 2e5, 0.3, 0.03
    law = NeoHookean(modulus, 0.0, viscosity_pa_s=eta, density_kg_m3=600.0)
    lattice = clamped_lattice(length, (depth, depth), (int(cells), 2, 2), CLAMP_REACH)
    rest = rest_nodes(lattice)
    frequency = 0.5 * np.pi * np.sqrt(modulus / 600.0) / length
    ratio = eta * frequency / modulus
    velocity = np.zeros_like(rest)
    velocity[:, 0] = 0.02 * np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, length) / length)
    times = np.linspace(0.0, 2 * 2 * np.pi / frequency * max(1.0, 2 * ratio), 40)
    nodes = run(lattice, law, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity)
    end = path(lattice, nodes, (length, depth / 2, depth / 2))[:, 0] - length
    root = np.sqrt(complex(ratio**2 - 1)) * frequency
    exact = 0.02 * np.real(np.exp(-ratio * frequency * times) * np.sinh(root * times) / root)
    return float(np.abs(end - exact).max() / np.abs(exact).max())


def rod_friction(cells: float) -> float:
    """Relative error of the decay of a clamped rod's bending under internal friction, rate tau omega^2 / 2."""
    length, tau = 0.3, 1e-3
    law = RodLaw(stretching_n=200.0, bending_n_m2=2e-2, relaxation_s=tau, density_kg_m=0.05)
    lattice = clamped_lattice(length, (), (int(cells),))
    rest = rest_nodes(lattice)
    frequency = 1.8751040687**2 * np.sqrt(law.bending_n_m2 / law.density_kg_m) / length**2
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.01 * np.clip(rest[:, 0] / length, 0, None) ** 2
    times = np.linspace(0.0, 6 * 2 * np.pi / frequency, 300)
    nodes = run(lattice, law, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity)
    rate = ringing(times[60:], path(lattice, nodes, (length,))[60:, 2], frequency)[2]
    return rate / (0.5 * tau * frequency**2) - 1


def swing_drag(cells: float) -> float:
    """Relative error of the decay of a clamped rod's bending under linear drag, rate c / 2."""
    length = 0.3
    law = RodLaw(stretching_n=200.0, bending_n_m2=2e-2, density_kg_m=0.05)
    lattice = clamped_lattice(length, (), (int(cells),))
    rest = rest_nodes(lattice)
    frequency = 1.8751040687**2 * np.sqrt(law.bending_n_m2 / law.density_kg_m) / length**2
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.01 * np.clip(rest[:, 0] / length, 0, None) ** 2
    times = np.linspace(0.0, 6 * 2 * np.pi / frequency, 300)
    problem = Problem(lattice, law, rest, np.zeros(3), drag_per_s=DRAG_PER_S)
    dt = 0.5 * TotalLagrangian(problem).time_step_s
    nodes = run(
        lattice, law, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity,
        drag_per_s=DRAG_PER_S, time_step_s=dt,
    )  # fmt: skip
    rate = ringing(times, path(lattice, nodes, (length,))[:, 2], frequency)[2]
    return rate / (0.5 * DRAG_PER_S) - 1


CASES = (
    Case("drag", "fall with linear drag, 0.6 s", "g t/c − g (1 − exp(−c t))/c²", "dt", (1.0, 0.5, 0.25), drag,
         1e-3, 0.8, size=float),
    Case("swing_drag", "clamped rod, decay under drag", "c / 2", "dx", (10, 20), swing_drag, 5e-3,
         no_order="errors of both signs"),
    Case("viscosity", "clamped bar, axial decay under Kelvin-Voigt friction", "η ω² / E", "dx", (10, 20, 40),
         viscosity, 5e-3, 1.5),
    Case("strong_viscosity", "pushed bar, friction ten times what an explicit step bears: its end", "damped oscillator",
         "dx", (10, 20, 40), strong_viscosity, 5e-3, 1.0),
    Case("creeping_viscosity", "the same at a hundred times, where it creeps back", "damped oscillator", "dx",
         (10, 20, 40), creeping_viscosity, 2e-3, 1.0),
    Case("rod_friction", "clamped rod, decay under internal friction", "τ ω² / 2", "dx", (8, 16, 32),
         rod_friction, 1e-2, 1.5),
    Case("tilt", "fall under tilted gravity", "½ R g t²", "dx", (64, 512), tilt, 1e-9),
    Case("lag", "gripped point under an actuation lag", "record(t − lag)", "control rate", (46, 91, 181), lag,
         2e-3, 1.5),
)  # fmt: skip
