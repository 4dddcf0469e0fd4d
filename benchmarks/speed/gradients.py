"""Gradients through the engine: what one costs, what it keeps in memory, and how well it agrees with differences.

Cost: a clamped bar of 2000 particles under gravity for 100 frames; one gradient (its own forward pass included) over
one run without a gradient, by processor time; the same with friction in stages. Agreement: 400 substeps of a bar, a
sheet and a rope that are held at one end and shaken; random weights on the tracked points; central differences of whole
runs at the same time step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from benchmarks.harness import Report, run_alone
from physworld.effects.registry import EFFECTS, effect
from physworld.engine.gradients.adjoint import Adjoint
from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.neo_hookean import NeoHookean
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene
from physworld.twin.build import build_twin
from physworld.twin.gradient import TwinRun, strength
from physworld.twin.grips import softly_held
from physworld.twin.twin import Twin

FRAMES, FPS = 100, 30.0
SUBSTEPS = 400
STRONG_PA_S = 3000.0
SHAPES, SOFTLY = ("solid", "sheet", "rope"), "softly held solid"  # whose grip holds a part of its section
SHOWN, SHOWN_FPS = 5, 60.0  # frames of the shaken bodies
NOT_SMOOTH = {
    ("clamp_offset", "reach_m"): "it changes which nodes are held",
    ("plasticity", "inverse_yield_per_pa"): "a corner wherever a particle begins to yield",
    ("plasticity", "yield_radius_m"): "a corner wherever a particle begins to yield",
}
LARGE = {"air_drag_quadratic", "air_drag_linear", "wind", "viscosity_kelvin_voigt"}  # small in 0.13 s
GOAL, FRICTION_GOAL = 0.01, 0.03
_THIN = (("viscosity_kelvin_voigt", "relaxation_s", 0.1), ("viscoelastic_maxwell", "share", 0.3))
IN_STAGES = {
    "solid": (
        ("viscosity_kelvin_voigt", "viscosity_pa_s", 500.0),
        ("viscoelastic_maxwell", "shear_modulus_pa", 3e3),
    ),
    "sheet": _THIN,
    "rope": _THIN,
}
ON_THE_GROUND = (("adhesion", "traction_pa", 50.0), ("ground_friction", "height_m", 2e-4))


def measure(repeats: int, seed: int) -> Report:
    """Cost and agreement."""
    wp.config.quiet = True
    figures: dict[str, object] = {**cost(repeats), **cost_in_stages(repeats)}
    errors = agreement(seed)
    figures["errors"] = errors
    rows = [
        ["one gradient, in forward runs", f"{figures['gradient_in_forwards']:.2f}", "6"],
        ["... with every frame run twice", f"{figures['gradient_in_forwards_twice']:.2f}", "6"],
        ["... through friction in stages", f"{figures['gradient_in_forwards_stages']:.2f}", "6"],
        ["memory for 100 frames [MB]", f"{figures['gradient_memory_mb']:.0f}", "100"],
        ["... with every frame run twice", f"{figures['gradient_memory_twice_mb']:.0f}", "100"],
    ]
    for shape in (*SHAPES, SOFTLY):
        found = {name: error for name, error in errors.items() if name.startswith(f"{shape} ")}
        for name in ("log stiffness field", "log density field"):
            rows.append([f"{shape}: {name}", f"{found[f'{shape} {name}']:.1e}", f"{GOAL:.0e}"])
        effects = {
            name: error
            for name, error in found.items()
            if " field" not in name and " on the ground: " not in name
        }
        worst = max(effects, key=lambda name: effects[name])
        rows.append(
            [f"{shape}: {len(effects)} strengths, median", f"{np.median(list(effects.values())):.1e}", ""]
        )
        rows.append(
            [f"... the worst: {worst.removeprefix(shape + ' ')}", f"{effects[worst]:.1e}", f"{GOAL:.0e}"]
        )
    for shape in SHAPES:
        for name in (
            "log stiffness field",
            "log density field",
            *(" ".join(known[:2]) for known in IN_STAGES[shape]),
        ):
            error = errors[f"stages: {shape} {name}"]
            rows.append([f"{shape}, friction in stages: {name}", f"{error:.1e}", f"{GOAL:.0e}"])
    for shape in SHAPES:
        name = f"{shape} on the ground: log friction"
        rows.append([name, f"{errors[name]:.1e}", f"{FRICTION_GOAL:.0e}"])
    for known, which, _ in ON_THE_GROUND:
        name = f"on the ground: {known} {which}"
        rows.append([f"solid {name}", f"{errors[name]:.1e}", f"{FRICTION_GOAL:.0e}"])
    rows.append(["friction of the ground", f"{errors['friction of the ground']:.1e}", f"{FRICTION_GOAL:.0e}"])
    return Report(
        name="gradients",
        title="Gradients",
        figures=figures,
        header=["", "found", "at most"],
        rows=rows,
        notes=[
            "Errors are relative, against central differences; a solid strains in single precision, which limits the "
            "differences more than the gradient.",
            *(f"Left out: {name} {which}: {why}." for (name, which), why in NOT_SMOOTH.items()),
        ],
        seed=seed,
    )


def cost(repeats: int) -> dict[str, float]:
    """``gradient_in_forwards``, ``gradient_memory_mb``; the same with every frame run twice."""
    problem, held, times = _bar()
    x, v = problem.rest, np.zeros_like(problem.rest)
    plain = TotalLagrangian(problem)
    kinds = {"": Adjoint(problem), "_twice": Adjoint(problem, memory_mb=0.0)}
    found: dict[str, float] = {}

    def gradient(adjoint: Adjoint) -> int:
        run = adjoint.run(x, v, held, times)
        run.gradient(run.nodes - run.nodes[:1])
        return run.nbytes

    for name, adjoint in kinds.items():
        found[f"gradient_memory{name}_mb"] = gradient(adjoint) / 1e6  # also compiles
    seconds: dict[str, list[float]] = {"forward": [], "": [], "_twice": []}
    for _ in range(repeats):
        seconds["forward"].append(_seconds(lambda: plain.run(x, v, held, times)))
        for name, adjoint in kinds.items():
            seconds[name].append(_seconds(lambda adjoint=adjoint: gradient(adjoint)))
    for name in kinds:
        found[f"gradient_in_forwards{name}"] = float(np.median(seconds[name]) / np.median(seconds["forward"]))
    found["gradient_forward_s"] = float(np.median(seconds["forward"]))
    return found


def cost_in_stages(repeats: int) -> dict[str, float]:
    """``gradient_in_forwards_stages``: the bar with a viscosity that is taken in stages, forward and back."""
    problem, held, times = _bar()
    problem = replace(problem, law=replace(problem.law, viscosity_pa_s=STRONG_PA_S))
    x, v = problem.rest, np.zeros_like(problem.rest)
    plain, adjoint = TotalLagrangian(problem), Adjoint(problem)

    def gradient() -> None:
        run = adjoint.run(x, v, held, times)
        assert np.all(run.stages)
        run.gradient(run.nodes - run.nodes[:1])

    gradient()  # compiles
    seconds = [(_seconds(gradient), _seconds(lambda: plain.run(x, v, held, times))) for _ in range(repeats)]
    back, forward = np.median(seconds, axis=0)
    return {"gradient_in_forwards_stages": float(back / forward)}


def agreement(seed: int) -> dict[str, float]:
    """Relative errors by name."""
    errors: dict[str, float] = {}
    for shape, scene in _scenes().items():
        twin = softly_held(replace(build_twin(scene, 300), ground_height_m=None))
        errors.update(_fields(shape, twin, scene, seed))
        for name, kind in EFFECTS.items():
            if kind.refuses(twin) is not None:
                continue
            for known in kind.strengths(twin):
                if known.gate and (name, known.name) not in NOT_SMOOTH:
                    value, step = 2 * known.probe, 0.2 * known.probe
                    if twin.lattice.dim == 3 and name in LARGE:
                        value, step = 10 * known.probe, 5 * known.probe
                    errors[f"{shape} {name} {known.name}"] = _strength(
                        twin, scene, name, known.name, value, step, seed, float(shape == SOFTLY)
                    )
    for shape in SHAPES:
        errors.update(_in_stages(shape, seed))
    for shape in SHAPES:
        scene = _scenes()[shape]
        errors[f"{shape} on the ground: log friction"] = _friction_field(build_twin(scene, 300), scene, seed)
    scene = _scenes()["solid"]
    for name, which, value in ON_THE_GROUND:
        errors[f"on the ground: {name} {which}"] = _strength(
            _sliding(build_twin(scene, 300)), scene, name, which, value, 0.02 * value, seed
        )
    errors["friction of the ground"] = _strength(
        build_twin(scene, 300), scene, "ground_friction", "change", 0.1, 2e-3, seed
    )
    return errors


def _fields(shape: str, twin: Twin, scene: Scene, seed: int) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    count, step = twin.lattice.fill.size, 1e-4 if twin.lattice.dim < 3 else 3e-3
    run = _run(twin, scene, _step())
    weights = rng.normal(size=run.tracks.shape)
    gradient, _ = run.gradient(weights)
    found = {}
    for column, (name, along_log) in enumerate(
        (("log stiffness field", gradient.log_stiffness), ("log density field", gradient.log_density))
    ):
        worst = 0.0
        for _ in range(3):
            along = rng.normal(size=count)
            properties = np.zeros((count, 2))
            properties[:, column] = step * along
            ends = [_loss(twin, scene, weights, _step(), sign * properties) for sign in (1, -1)]
            expected = (ends[0] - ends[1]) / (2 * step)
            cancelled = np.linalg.norm(along_log)  # a direction on which everything cancels tests nothing
            worst = max(worst, abs(along_log @ along - expected) / max(abs(expected), 0.3 * cancelled))
        found[f"{shape} {name}"] = float(worst)
    return found


def _in_stages(shape: str, seed: int) -> dict[str, float]:
    """Errors of a body whose friction is taken in stages."""
    scene = _scenes()[shape]
    twin = replace(build_twin(scene, 300), ground_height_m=None)
    for name, which, value in IN_STAGES[shape]:
        twin = twin.with_effect(effect(name, **{which: value}))
    assert np.all(_run(twin, scene, _step()).recorded.stages)
    found = _fields(f"stages: {shape}", twin, scene, seed)
    for name, which, value in IN_STAGES[shape]:
        step = 0.02 * value if twin.lattice.dim == 3 else 1e-3 * value
        found[f"stages: {shape} {name} {which}"] = _strength(twin, scene, name, which, value, step, seed, 1.0)
    return found


def _friction_field(twin: Twin, scene: Scene, seed: int) -> float:
    """Error of the gradient by the ground's friction of a body that slides on it, on an uneven field."""
    twin = _sliding(twin)
    count, step = twin.lattice.fill.size, 1e-3 if twin.lattice.dim < 3 else 1e-2
    field, dt = 0.5 * np.linspace(-1.0, 1.0, count), 0.5 * _step()
    track = scene.control_track()
    properties = np.stack([0 * field, 0 * field, field], axis=1)
    run = TwinRun(twin, *track, scene.times, properties=properties, time_step_s=dt)
    weights = 1.0 + np.random.default_rng(seed).normal(size=run.tracks.shape)
    gradient, _ = run.gradient(weights)
    worst = 0.0
    for along in (np.ones(count), np.linspace(0.0, 1.0, count)):
        change = properties * 0
        change[:, 2] = step * along
        ends = [_loss(twin, scene, weights, dt, properties + sign * change) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        worst = max(worst, abs(gradient.log_friction @ along - expected) / abs(expected))
    return float(worst)


def _sliding(twin: Twin) -> Twin:
    """The body let go on the ground, sliding."""
    low = float(twin.body.start[:, 2].min() if twin.lattice.dim < 3 else twin.particles_start[:, 2].min())
    velocity = np.zeros_like(twin.body.start)
    velocity[:, :2] = [0.3, 0.5]
    return replace(
        twin,
        ground_height_m=low - 1e-3,
        ground_friction=0.4,
        held_nodes=tuple(h[:0] for h in twin.held_nodes),
        body=replace(twin.body, start_velocity=velocity),
    )


def _strength(
    twin: Twin, scene: Scene, name: str, which: str, value: float, step: float, seed: int, mean: float = 0.0
) -> float:
    """Error of the gradient by a strength; ``mean`` of the random weights, where without one they would cancel."""

    def changed(strength: float) -> Twin:
        return twin.with_effect(effect(name, **{which: strength}))

    dt = min(_step(), 0.8 * TwinRun(changed(value), *scene.control_track(), scene.times[:2]).time_step_s)
    run = _run(changed(value), scene, dt)
    weights = mean + np.random.default_rng(seed).normal(size=run.tracks.shape)
    _, found = run.gradient(weights, {"s": strength(changed(value), name, which)})
    ends = [_loss(changed(value + sign * step), scene, weights, dt) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * step)
    return float(abs(found["s"] - expected) / abs(expected)) if expected else abs(found["s"])


def _step() -> float:
    return (SHOWN - 1) / SHOWN_FPS / SUBSTEPS * (1 + 1e-9)


def _run(twin: Twin, scene: Scene, dt: float) -> TwinRun:
    return TwinRun(twin, *scene.control_track(), scene.times, time_step_s=dt)


def _loss(
    twin: Twin, scene: Scene, weights: np.ndarray, dt: float, properties: np.ndarray | None = None
) -> float:
    run = twin.integration(*scene.control_track(), scene.times, properties=properties)
    nodes = TotalLagrangian(run.problem, dt).run(twin.body.start, run.velocity, run.held, run.knots)
    return float(np.sum(weights * twin.observe(run.at_frames(twin.body.start, nodes), scene.times)))


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _bar() -> tuple[Problem, HeldNodes, np.ndarray]:
    lattice = box_lattice(np.zeros(3), np.array([0.25, 0.125, 0.125]), (10, 5, 5))
    law = NeoHookean(1e5, 0.35, density_kg_m3=1000.0)
    times = np.arange(FRAMES + 1) / FPS
    rest = lattice.node_coordinates
    nodes = np.unique(lattice.cell_nodes[lattice.cells[:, 0] < 1])
    positions = np.repeat(rest[nodes][None], len(times), axis=0)
    problem = Problem(lattice, law, rest, np.array([0.0, 0.0, -9.81]))
    return problem, HeldNodes(nodes, positions, 0 * positions), times


def _scenes() -> dict[str, Scene]:
    plate = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.0, 0.03]])
    size = np.array([0.16, 0.04, 0.04])
    line = np.linspace([0.04, 0.02, 0.04], [0.16, 0.02, 0.04], 4)
    plane = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    bar = Body(size_m=size, box_min_m=np.zeros(3), box_max_m=size, density_kg_m3=500.0)
    grip = Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.04, 0.04]))
    corner = Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.02, 0.02]))
    return {
        "solid": _scene("beam", line, plate, bar, (grip,), Ground(-0.003, 0.4)),
        "sheet": _scene(
            "sheet", np.concatenate([plane, np.zeros((9, 1))], axis=1), plate, Body(thickness_m=2e-3)
        ),
        "rope": _scene("rope", np.linspace([0, 0, 0], [0.3, 0, 0], 5), plate[:1], Body(radius_m=0.004)),
        SOFTLY: _scene("beam", line, plate, bar, (corner,), Ground(-0.003, 0.4)),
    }


def _scene(
    kind: str,
    points: np.ndarray,
    controllers: np.ndarray,
    body: Body,
    grips: tuple[Grip, ...] = (),
    ground: Ground | None = None,
) -> Scene:
    times = np.arange(SHOWN) / SHOWN_FPS
    lift = np.sin(12.0 * times)[:, None, None] ** 2 * np.array([0.01, 0.02, 0.02])
    return Scene(
        name=kind, kind=kind, points=np.repeat(points[None], SHOWN, axis=0),
        visible=np.ones((SHOWN, len(points)), dtype=bool), controllers=controllers + lift, times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]), noise_sigma_m=None, train=(0, SHOWN - 1), test=(SHOWN - 1, SHOWN),
        initial_state=UNDEFORMED_AT_REST, body=body, grips=grips, ground=ground,
    )  # fmt: skip


if __name__ == "__main__":
    run_alone(measure)
