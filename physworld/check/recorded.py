"""A recording as far as its information goes: its prediction, what whitens residuals, and the assumed discrepancy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.check.discrepancy import Discrepancy, discrepancy_of
from physworld.errors import SimulationError
from physworld.estimation.noise import Split, freeze, noise_sigma
from physworld.estimation.simulations import Job, Simulations, nodes_of
from physworld.estimation.uncertain import doubtful
from physworld.estimation.whitening import Whitener, responses, whitener
from physworld.scene import Scene
from physworld.twin.twin import Twin

BLOCKS, SHORTEST_BLOCK = 12, 3  # of frames, as a trace has them: a discrepancy is independent between blocks


@dataclass(frozen=True)
class Recorded:
    """A recording, measured or imagined, under the declared physics.

    Attributes:
        frames: from the first to before this one.
        tracks: predicted, (frames, N, 3) [m].
        white: of its residuals (M,).
        discrepancy: of the model.
        motion_m: root mean squared way of the points from where they start, per axis [m].
        kappa: the discrepancy's deviation per axis that is assumed [m].
    """

    frames: int
    tracks: Array
    white: Whitener
    discrepancy: Discrepancy
    motion_m: float
    kappa: float


def recorded(
    simulations: Simulations, scene: Scene, twin: Twin, sigma: float | None, share: float
) -> Recorded:
    """What the training frames of a scene would say, if this twin were the truth.

    Args:
        simulations: under the scene's drive.
        scene: whose sightings, times and first frame count.
        twin: the declared physics.
        sigma: noise [m]; None: the scene's own, declared or estimated.
        share: of the motion, that the discrepancy has.

    Raises:
        SimulationError: the declared physics cannot be simulated.
        ValueError: no noise is known.
    """
    whole = scene.train[1] >= scene.frame_count
    split = _all_of(scene) if whole else freeze(scene, BLOCKS, SHORTEST_BLOCK)
    frames = split.train[1]
    nodes = nodes_of(Job(twin, frames), simulations.drive)
    simulations.count += 1
    tracks = twin.observe(nodes, scene.times[:frames])
    if not np.isfinite(tracks).all():
        raise SimulationError(f"the declared physics leaves the numbers within {frames} frames")
    sigma = sigma or noise_sigma(scene, split, tracks)
    if sigma is None:
        raise ValueError(
            "no noise is declared and none can be estimated from so few sightings; give it in metres per axis"
        )
    white = whitener(scene, split, sigma, responses(twin, nodes))
    white = white.knowing(doubtful(simulations, scene, twin, tracks, sigma))
    places = np.nan_to_num(scene.points[0])
    owners = np.zeros(len(places), dtype=int)
    discrepancy = discrepancy_of(white, split, scene.times, places, owners, tracks)
    motion_m = float(np.sqrt(np.mean((tracks - tracks[0]) ** 2)))
    return Recorded(frames, tracks, white, discrepancy, motion_m, share * motion_m)


def _all_of(scene: Scene) -> Split:
    """Every frame but the first."""
    first, end = max(scene.train[0], 1), scene.frame_count
    count = int(np.clip((end - first) // SHORTEST_BLOCK, 1, BLOCKS))
    return Split((first, end), (end, end), np.linspace(first, end, count + 1).round().astype(int))
