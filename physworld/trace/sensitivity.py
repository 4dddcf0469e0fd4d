"""What every unknown does to the prediction, one simulation each; what the numerics do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.simulations import Job, Simulations
from physworld.estimation.whitening import Whitener
from physworld.evaluate.numerics import refined
from physworld.scene import Scene
from physworld.trace.candidates import Candidate
from physworld.trace.unknowns import already
from physworld.twin.twin import Twin


@dataclass(frozen=True)
class Response:
    """A candidate's whitened sensitivities per unit of its unknowns, (M, k), and where one run failed."""

    candidate: Candidate
    columns: Array
    failed: bool = False


def candidate_responses(
    simulations: Simulations,
    whitener: Whitener,
    twin: Twin,
    base: Array,
    chosen: list[Candidate],
    frames: int,
) -> list[Response]:
    """Sensitivities of every candidate's gates, one batch of simulations for all.

    At zero, or where the twin has them already: a clamp's reach and a rope's grip are calibrated.

    Args:
        simulations: of the recordings.
        whitener: of their residuals (M,).
        twin: the calibrated twin.
        base: its tracks, (frames, N, 3) [m].
        chosen: candidates.
        frames: that count.
    """
    jobs, owners = [], []
    for number, candidate in enumerate(chosen):
        prepared = candidate.prepared(twin)
        for unknown in candidate.unknowns():
            here = unknown.starting(already(twin, unknown))
            step = here.probe
            jobs.append(Job(unknown.at(prepared, here.start + step), frames))
            owners.append((number, step))
    found = simulations.run(jobs)
    columns: list[list[Array]] = [[] for _ in chosen]
    failed = [False] * len(chosen)
    for (number, step), tracks in zip(owners, found, strict=True):
        failed[number] |= tracks is None
        change = (
            np.zeros(3 * len(whitener.measured)) if tracks is None else whitener.change(tracks - base) / step
        )
        columns[number].append(change)
    return [
        Response(c, np.stack(own, axis=1), bad) for c, own, bad in zip(chosen, columns, failed, strict=True)
    ]


def numerical_directions(
    simulations: Simulations,
    scene: Scene,
    twin: Twin,
    base: Array,
    budget: int,
    refinement: float,
) -> tuple[dict[str, Array], Twin]:
    """Changes of the prediction (frames, N, 3) that are the solver's own, by name; and the twin on finer cells.

    Of a mesh of triangles the cells are what is supposed of the recording: it has no finer ones, and is its own.
    ``base``: the prediction (frames, N, 3); other arguments as of :class:`physworld.trace.recordings.JointSimulations`.
    """
    frames = len(base)
    finer = twin
    variants = {"half the time step": Job(twin, frames, 0.5)}
    if twin.lattice.smooth:
        finer = refined(scene, twin, budget, refinement)
        coarser = refined(scene, twin, budget, 1.0 / refinement)
        variants = {"finer cells": Job(finer, frames), "coarser cells": Job(coarser, frames), **variants}
    found = zip(variants, simulations.run(list(variants.values())), strict=True)
    return {name: tracks - base for name, tracks in found if tracks is not None}, finer
