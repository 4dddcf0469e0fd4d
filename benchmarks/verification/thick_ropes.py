"""Ropes of thick section that two hands hold nearly straight, recorded by PyElastica's Cosserat rods, and calibrated.

Nothing acts on them that the twin has not, so that a twin should leave the noise: where the points are is averaged over
the training frames. Needs the extra ``bench``.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness import Report, run_alone
from benchmarks.peers.elastica_ropes import Rope
from benchmarks.peers.finite_elements import Acting, Floats
from benchmarks.trace.hidden_bodies import TOP_M, Cord, Hand, Motion, Recorder
from benchmarks.trace.hidden_effects import FPS, FRAMES, GRAVITY, SIGMA_M, before_a_camera
from physworld.calibrate import calibrate

POISSON, TRACKED = 0.4, 40
CORDS = {
    f"radius {1e3 * radius:.0f} mm{', hands turn' if turn else ''}": Cord(
        0.42, radius, young, 900.0, (1.0, 0.0, 0.0), (0.004, 0.03, 0.02), turn
    )
    for radius, young, turn in (
        (0.006, 1e6, 0.0),
        (0.006, 1e6, 0.3),
        (0.015, 4e5, 0.0),
        (0.015, 4e5, 0.3),
        (0.025, 3e5, 0.0),
    )
}


def measure(repeats: int, seed: int) -> Report:
    """Every rope once; the noise is drawn by ``seed``, repeats change nothing."""
    figures: dict[str, dict[str, float]] = {}
    rows = []
    for number, (name, cord) in enumerate(CORDS.items()):
        figures[name] = found = _fitted(name, cord, 100 * seed + number)
        rows.append(
            [
                name,
                f"{found['training']:.2f}",
                f"{found['unseen']:.2f}",
                f"{found['bending_ratio']:.2f}",
                f"{found['stretching_ratio']:.2f}",
            ]
        )
    return Report(
        name="thick_ropes",
        title="Thick ropes in two hands, recorded by PyElastica",
        figures=figures,
        header=["rope", "left over the noise, training", "unseen frames", "E I over the truth",
                "E A over the truth"],
        rows=rows,
        notes=[
            "0.42 m long, level, 60 frames at 30 Hz, 42 of them for training, 40 points on the surface, 1 mm of noise.",
            "Nothing acts beside gravity and the hands: a perfect model leaves about 1.",
        ],
        seed=seed,
    )  # fmt: skip


def _fitted(name: str, cord: Cord, seed: int) -> dict[str, float]:
    """What a calibration leaves, over the noise, and its stiffnesses over the truth."""
    rng = np.random.default_rng(900 + seed)
    rope = Rope(cord.length_m, cord.radius_m, np.array([0.0, 0.0, TOP_M]), np.array(cord.way), cord.young_pa, POISSON,
                cord.density_kg_m3)  # fmt: skip
    motions = [Motion(10 * seed + hand, cord.stroke_m, cord.turn_rad) for hand in range(2)]
    ends = [rope.held, rope.nodes[: -len(rope.held) - 1 : -1]]
    room = cord.radius_m * np.sqrt(1.0 - rope.along**2)
    hands = [
        Hand(np.array([end.min(axis=0) - room, end.max(axis=0) + room]), end[0], motion)
        for end, motion in zip(ends, motions, strict=True)
    ]
    seen = rng.uniform((0.0, 0.0), (1.0, 2.0 * np.pi), (TRACKED, 2))

    def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
        near, far = (partial(motion.place, late_s) for motion in motions)
        return rope.record(acting, near, at, seen, far)

    recorder = Recorder(hands, tracks, partial(cord.inside, rope.along))
    clean = tracks(Acting(gravity_m_s2=GRAVITY), 0.0, np.arange(FRAMES) / FPS)
    scene = before_a_camera(name, cord, recorder, clean, rng)
    result = calibrate(scene)
    error = np.where(scene.visible[..., None], result.tracks - scene.points, np.nan) / SIGMA_M
    begun = scene.train[1]
    area, inertia = np.pi * cord.radius_m**2, 0.25 * np.pi * cord.radius_m**4
    law = result.twin.law
    return {
        "training": float(np.sqrt(np.nanmean(error[1:begun] ** 2))),
        "unseen": float(np.sqrt(np.nanmean(error[begun:] ** 2))),
        "bending_ratio": float(law.bending_n_m2 / (cord.young_pa * inertia)),
        "stretching_ratio": float(law.stretching_n / (cord.young_pa * area)),
    }


if __name__ == "__main__":
    run_alone(measure)
