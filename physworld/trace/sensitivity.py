"""What every unknown does to the prediction, one simulation each; what the numerics do; what decoys would do."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
    level: float = 1.0,
) -> tuple[dict[str, Array], Twin]:
    """Changes of the prediction (frames, N, 3) that are the solver's own, by name; and the twin on finer cells.

    Of a mesh of triangles the cells are what is supposed of the recording: it has no finer ones, and is its own.

    Args:
        level: cells of ``twin`` are this many times smaller than the budget says.
    """
    frames = len(base)
    finer = twin
    variants = {"half the time step": Job(twin, frames, 0.5)}
    if twin.lattice.smooth:
        finer = refined(scene, twin, budget, level * refinement)
        coarser = refined(scene, twin, budget, level / refinement)
        variants = {"finer cells": Job(finer, frames), "coarser cells": Job(coarser, frames), **variants}
    found = zip(variants, simulations.run(list(variants.values())), strict=True)
    return {name: tracks - base for name, tracks in found if tracks is not None}, finer


def decoys(
    responses: list[Response], whitener: Whitener, tracks_shape: tuple[int, int], count: int, seed: int
) -> list[Array]:
    """Sensitivities that are none, (M, 1): smooth in time and over the points, with the spectra of real ones.

    Phases of a real sensitivity's time courses are drawn anew for every point pattern, which leaves the size, the
    slowness and the shapes, and takes away every relation to what was measured.

    Args:
        responses: of real candidates.
        whitener: of the residuals (M,).
        tracks_shape: training frames and points.
        count: decoys.
        seed: of their phases.
    """
    rng = np.random.default_rng(seed)
    frames, points = tracks_shape
    usable = [r.columns[:, 0] for r in responses if not r.failed and np.any(r.columns[:, 0])]
    made = []
    for number in range(count if usable else 0):
        source = usable[number * len(usable) // count]
        field = np.zeros((frames, points, 3))
        field[whitener.visible] = source.reshape(-1, 3)
        u, s, vt = np.linalg.svd(field.reshape(frames, -1), full_matrices=False)
        spectrum = np.fft.rfft(u * s, axis=0)
        turn = np.exp(2j * np.pi * rng.uniform(size=spectrum.shape))
        turn[0] = rng.choice([-1.0, 1.0], size=turn.shape[1])
        fresh = np.fft.irfft(spectrum * turn, n=frames, axis=0) @ vt
        made.append(fresh.reshape(frames, points, 3)[whitener.visible].reshape(-1, 1))
    return made


def refinement_of(twin: Twin, finer: Twin) -> Twin:
    """``finer``'s lattice with the parameters and effects of ``twin``."""
    return replace(
        finer,
        body=replace(finer.body, points=twin.body.points, offsets=twin.body.offsets),
        law=twin.law,
        air_drag_per_s=twin.air_drag_per_s,
        grip_softness=twin.grip_softness,
        ground_friction=twin.ground_friction,
        effects=twin.effects,
    )
