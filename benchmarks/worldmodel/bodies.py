"""Four bodies, their twins, and demonstrations of them on a clock that is ``SUBTICKS`` times finer than the model's.

Every model of the study learns from the same ``TAUGHT`` episodes and is judged on two sets that none has seen:
``unseen`` ones drawn as the taught ones are, and ``turned`` ones, whose grips turn as one rigid body by up to
``TURN_RAD`` about any axis (sheets, which hang from two corners: about the vertical) and stay there. Episodes are
simulated by the calibrated twin and kept in a file a body, vertices only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.models import REPOSITORY, SHARED
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.demonstrate import DemonstrationConfig, derived_seed
from physworld.demonstrate.episode import EpisodePlan, check_episode, plan_episode
from physworld.demonstrate.limits import training_track
from physworld.demonstrate.motion import rigid_points
from physworld.errors import SimulationError
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import model_dt
from physworld.worldmodel.dataset import Track, graph_origin
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph
from physworld_scenes.bundle import read_bundle

SUBTICKS = 8
TAUGHT, JUDGED = 48, 8
TAUGHT_FRAMES, JUDGED_FRAMES = 61, 101
TURN_RAD = (0.5 * np.pi, np.pi)
TURN_S = (0.8, 1.6)
FIT = CalibrationConfig(particle_budget=500, max_simulations=40)
PARTS = ("taught", "unseen", "turned")


@dataclass(frozen=True)
class Body:
    """A scene by its folder, and the weights of the patterns of motion that are taught (None: the default mix)."""

    folder: Path
    patterns: dict[str, float] | None = None
    upright: bool = False


BODIES = {
    "beam": Body(REPOSITORY / "sample" / "soft_beam"),
    "rope": Body(REPOSITORY / "sample" / "hanging_rope"),
    "cloth": Body(SHARED / "undeclared" / "d06", upright=True),
    "toy": Body(SHARED / "undeclared" / "d03", patterns={"single": 1.0, "twist": 1.0}),
}


@dataclass(frozen=True)
class Episodes:
    """What a body showed.

    Attributes:
        spec: the graph, on the model's clock.
        groups: controllers of each rigid grip.
        parts: by name: positions (E, T, V, 3) [m] every ``SUBTICKS``-th of a tick, float32 from the graph's origin, and
            Φ (E, n, 2).
    """

    spec: GraphSpec
    groups: tuple[np.ndarray, ...]
    parts: dict[str, tuple[np.ndarray, np.ndarray]]

    def tracks(self, part: str, every: int = SUBTICKS) -> list[Track]:
        """Episodes at every so many subticks."""
        positions, phi = self.parts[part]
        return [
            Track(torch.as_tensor(path[::every]), torch.as_tensor(field))
            for path, field in zip(positions, phi, strict=True)
        ]


def episodes_of(name: str, folder: Path, config: WorldModelConfig, taught: int = TAUGHT) -> Episodes | None:
    """The body's episodes, made once and kept in ``folder``; None where its scene is not on this machine.

    Args:
        name: of the body.
        folder: that keeps twins and episodes.
        config: number of vertices of the graph.
        taught: how many episodes there are to learn from.
    """
    body = BODIES[name]
    if not body.folder.is_dir():
        return None
    scene, twin = read_bundle(body.folder), _twin_of(name, body, folder)
    spec = build_graph(
        twin.particles_rest,
        twin.particles_start,
        twin.controllers_start,
        dt_s=model_dt(scene.fps),
        config=config,
        control_groups=twin.controller_groups,
        ground_height_m=twin.ground_height_m,
        gravity_m_s2=np.asarray(scene.gravity_m_s2),
    )
    path = folder / f"{name}-{config.vertices}{'' if taught == TAUGHT else f'-{taught}'}.npz"
    if not path.exists():
        made = {part: _simulated(scene, twin, spec, body, part, taught) for part in PARTS}
        arrays = {f"{part}.{k}": values for part, pair in made.items() for k, values in enumerate(pair)}
        np.savez(path.with_suffix(".part.npz"), allow_pickle=False, **arrays)
        path.with_suffix(".part.npz").replace(path)
    with np.load(path, allow_pickle=False) as held:
        parts = {part: (held[f"{part}.0"], held[f"{part}.1"]) for part in PARTS}
    return Episodes(spec, tuple(twin.controller_groups), parts)


def _twin_of(name: str, body: Body, folder: Path) -> Twin:
    path = folder / f"{name}-twin.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        twin = calibrate(read_bundle(body.folder), FIT).twin
        np.savez(path.with_suffix(".part.npz"), allow_pickle=False, **twin.to_arrays())
        path.with_suffix(".part.npz").replace(path)
    with np.load(path, allow_pickle=False) as held:
        return Twin.from_arrays({key: held[key] for key in held.files})


def _simulated(
    scene: Scene, twin: Twin, spec: GraphSpec, body: Body, part: str, taught: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (E, T, V, 3) float32 and Φ (E, n, 2) float32 of accepted episodes of a part."""
    frames = TAUGHT_FRAMES if part == "taught" else JUDGED_FRAMES
    config = DemonstrationConfig(
        frames=frames, patterns=body.patterns, replay_share=0.0, control_substeps=SUBTICKS
    )
    count = taught if part == "taught" else JUDGED
    paths: list[np.ndarray] = []
    fields: list[np.ndarray] = []
    tried = 0
    while len(paths) < count:
        plan = plan_episode(scene, twin, config, derived_seed(1000 * PARTS.index(part), tried))
        tried += 1
        if part == "turned":
            plan = _turned(scene, twin, plan, np.random.default_rng(plan.seed), body.upright)
        try:
            particles = plan.drawn.twin(twin).simulate(
                plan.control_times,
                plan.control_points,
                plan.control_times,
                properties=plan.properties,
                from_rest=True,
            )
            check_episode(particles, plan)
        except SimulationError:
            if tried > 4 * count:
                raise
            continue
        together = np.concatenate(
            [particles[:, spec.particle_index], plan.control_points[:, spec.control_index]], axis=1
        )
        paths.append((together - graph_origin(spec, together[0, : spec.object_count])).astype(np.float32))
        fields.append(plan.properties[spec.particle_index, :2].astype(np.float32))
    return np.stack(paths), np.stack(fields)


def _turned(
    scene: Scene, twin: Twin, plan: EpisodePlan, rng: np.random.Generator, upright: bool
) -> EpisodePlan:
    """The plan with all control points turned as one rigid body about their middle, smoothly, and held there."""
    pose = training_track(scene)[1][0]
    axis = np.array([0.0, 0.0, 1.0]) if upright else rng.normal(size=3)
    angle = rng.uniform(*TURN_RAD) * rng.choice([-1.0, 1.0])
    share = np.clip((plan.control_times - 0.2) / rng.uniform(*TURN_S), 0.0, 1.0)
    eased = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    turns = eased[:, None] * (angle * axis / np.linalg.norm(axis))
    points = rigid_points(pose, np.zeros((len(eased), 3)), turns)
    ticks = slice(None, None, SUBTICKS)
    return replace(
        plan, control_points=points, controllers=points[ticks], motion="turned", size_m=4.0 * plan.size_m
    )
