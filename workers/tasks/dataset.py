"""Makes a dataset: one shard plans it, one shard makes each episode, one shard seals it.

An episode is written under the epoch of its lease and exists once its shard is committed: whatever a killed
or overtaken worker wrote belongs to nobody and is removed at sealing. Its seed follows from the dataset's
and its index alone, so a second attempt makes the same episode; an episode that is rejected (unstable, out of the
workspace) is drawn anew from the seed of its next try, and its reasons are kept. The seal reads every episode again,
compares digests, and writes the card of what they cover (:mod:`physworld_workers.tasks.dataset_card`).

On a GPU the first shard of a block simulates the whole block side by side, and the process keeps the rest for the
shards that follow; whoever makes an episode, its block is the same.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate import (
    DemonstrationConfig,
    StrengthRange,
    derived_seed,
    make_episode,
    plan_episode,
)
from physworld.demonstrate.coverage import Coverage
from physworld.demonstrate.episode import episode_frames, regrasp_share_of
from physworld.demonstrate.side_by_side import make_episodes
from physworld.errors import SimulationError
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.model.graph import MOST_KEPT, kept_vertices
from physworld_schemas.dataset import DatasetConfig, Episode
from physworld_schemas.trace import FoundEffect
from physworld_storage import resources, traces
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.errors import DatasetIncomplete, NotEnoughDisk
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.dataset_card import store_card
from physworld_workers.tasks.inputs import made_from, scene_of, twin_of

FLOAT_BYTES = 4
STORE_OVERHEAD = 1.05
MOST_COLUMNS = 3
"""Of an episode's properties: stiffness, density, and the ground's friction where a field of it is perturbed."""
WIDTHS = {"cpu": 1, "cuda": 16}
"""Episodes side by side, by the kind of device. On a CPU the gain is small and two workers would share it twice."""
RESERVED_BYTES = 256 * 2**20
"""Left free for database, logs and the model that follows."""


def plan(context: TaskContext, stores: Stores) -> HandlerResult:
    """Settle the size of the dataset and refuse one that the disk cannot hold."""
    payload = context.lease.payload
    config = DatasetConfig.model_validate(payload["config"])
    scene = scene_of(stores, payload["scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))
    demonstration = demonstration_of(config, _strengths(stores, payload.get("trace_id"), config))
    frames = episode_frames(scene, demonstration)
    with suppress(SimulationError):  # what the settings and the scene refuse is said before the first episode
        plan_episode(scene, twin, demonstration, derived_seed(config.seed % 2**63, 0))
    particles, controllers = len(twin.particles_rest), scene.controllers.shape[1]
    per_frame = 3 * FLOAT_BYTES * (particles + min(MOST_KEPT, particles) + controllers) + 8
    need = round(
        STORE_OVERHEAD * config.episodes * (frames * per_frame + MOST_COLUMNS * FLOAT_BYTES * particles)
    )
    _check_disk(stores, need, f"{config.episodes} episodes of {frames} frames x {particles} particles")
    return HandlerResult(
        {"episodes": config.episodes, "frames": frames, "particles": particles, "estimated_bytes": need}
    )


def episode(context: TaskContext, stores: Stores) -> HandlerResult:
    """Plan, simulate and write one episode."""
    lease = context.lease
    payload = lease.payload
    config = DatasetConfig.model_validate(payload["config"])
    index = int(payload["index"])
    scene = scene_of(stores, payload["scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))

    def progress(done: int, total: int) -> None:
        context.check()

    started = time.perf_counter()
    demonstration = demonstration_of(config, _strengths(stores, payload.get("trace_id"), config))
    arrays, attributes = _made(
        stores, payload["dataset_id"], scene, twin, config, demonstration, index, progress
    )
    simulated = time.perf_counter()
    context.check()
    arrays = arrays | _vertices(stores, payload["dataset_id"], twin, arrays["particles"])
    attributes |= {"index": index, "scene_id": payload["scene_id"], "fit_id": payload["fit_id"]}
    path, digest = stores.episodes.write(payload["dataset_id"], index, lease.epoch, arrays, attributes)
    written = time.perf_counter()
    frames, particles, _ = arrays["particles"].shape
    result = {
        "index": index,
        "path": path,
        "digest": digest,
        "seed": attributes["seed"],
        "frames": frames,
        "particles": particles,
        "motion": attributes["motion"],
        "seconds": simulated - started,
        "store_seconds": written - simulated,
        "rejected": attributes["rejected"],
    }
    return HandlerResult(result, digest)


def seal(context: TaskContext, stores: Stores) -> HandlerResult:
    """Read every episode again, compare digests, write the manifest, remove what belongs to nobody."""
    payload = context.lease.payload
    dataset_id = payload["dataset_id"]
    config = DatasetConfig.model_validate(payload["config"])
    with stores.database.reading() as session:
        episodes = resources.all_episodes(session, dataset_id)
    indices = [episode.index for episode in episodes]
    if indices != list(range(config.episodes)):
        missing = sorted(set(range(config.episodes)) - set(indices))
        raise DatasetIncomplete(
            f"dataset {dataset_id} holds {len(indices)} episodes of {config.episodes}; missing {missing[:20]}"
        )
    coverage = Coverage(len(episodes))
    for done, committed in enumerate(episodes, start=1):
        context.check()
        coverage.add(*stores.episodes.verified(committed.path, committed.digest))
        context.progress(done, len(episodes), "episodes", "verifying")
    manifest = stores.episodes.write_manifest(dataset_id, episodes)
    context.check()
    stores.episodes.remove_orphans(dataset_id, [committed.path for committed in episodes])
    inputs = made_from(stores, payload)
    card, pictures = store_card(stores.artifacts, dataset_id, manifest.sha256, config, coverage)
    result = {
        "digest": manifest.sha256,
        "statistics": _statistics(episodes, card),
        "artifacts": [artifact.model_dump(mode="json") for artifact in (manifest, *pictures)],
        "lineage": lineage_of(inputs, payload["config"], {"dataset": config.seed}),
    }
    return HandlerResult(result, manifest.sha256)


def _made(
    stores: Stores,
    dataset_id: str,
    scene: Scene,
    twin: Twin,
    config: DatasetConfig,
    demonstration: DemonstrationConfig,
    index: int,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Arrays and attributes of episode ``index``, alone or as one of its block."""
    seed = config.seed % 2**63
    width = WIDTHS[twin.device.partition(":")[0]]
    alone = not twin.form.supports("batches") or not twin.lattice.smooth
    alone |= regrasp_share_of(twin, demonstration) > 0.0 or bool(twin.openings)
    if width == 1 or alone or demonstration.strengths:
        return make_episode(scene, twin, demonstration, derived_seed(seed, index), progress)
    first = index - index % width
    seeds = [derived_seed(seed, other) for other in range(first, min(first + width, config.episodes))]
    block = stores.cached(
        ("episodes", dataset_id, first), lambda: make_episodes(scene, twin, demonstration, seeds, progress)
    )
    made = block[index - first]
    if isinstance(made, SimulationError):
        raise made
    arrays, attributes = made
    return arrays, dict(attributes)


def _vertices(stores: Stores, dataset_id: str, twin: Twin, particles: Array) -> dict[str, Array]:
    """The particles that world models take for their vertices, kept apart: the same in every episode of a dataset."""
    chosen = stores.cached(("vertices", dataset_id), lambda: kept_vertices(twin.particles_rest))
    return {"vertices": particles[:, chosen], "vertex_index": chosen.astype(np.int32)}


def demonstration_of(config: DatasetConfig, strengths: tuple[StrengthRange, ...] = ()) -> DemonstrationConfig:
    """The wire's settings as the library's."""
    return DemonstrationConfig(
        frames=config.frames,
        motion=config.motion,
        patterns=None if config.patterns is None else dict(config.patterns.items()),
        replay_share=config.replay_share,
        curvature_limit=config.curvature_limit,
        perturbation=config.perturbation,
        properties=tuple(config.properties),
        property_sigma=config.property_sigma,
        length_scale=config.length_scale,
        space_scale=config.space_scale,
        features=config.features,
        strengths=strengths,
        regrasp_share=config.regrasp_share,
        attempts=config.tries,
    )


def _strengths(stores: Stores, trace_id: str | None, config: DatasetConfig) -> tuple[StrengthRange, ...]:
    """Intervals of the strengths that the trace found; none where they are to stay as found."""
    if trace_id is None or config.effects == "as_found":
        return ()
    return stores.cached(("strengths", trace_id), lambda: _read_strengths(stores, trace_id))


def _read_strengths(stores: Stores, trace_id: str) -> tuple[StrengthRange, ...]:
    with stores.database.reading() as session:
        trace = traces.get_trace(session, trace_id)
    return strength_ranges(trace.effects) if traces.leaves_twin(trace) else ()


def strength_ranges(effects: Sequence[FoundEffect]) -> tuple[StrengthRange, ...]:
    """Those strengths of effects that have a value and an interval; an estimate outside of it widens it."""
    found = []
    for known in effects:
        for name, figure in known.parameters.items():
            low, high = figure.ci95 or (None, None)
            if figure.value is None or low is None or high is None:
                continue
            ends = (min(low, figure.value), max(high, figure.value))
            found.append(StrengthRange(known.name, name, figure.value, *ends))
    return tuple(found)


def _check_disk(stores: Stores, need: int, what: str) -> None:
    folder = stores.settings.store_folder
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if need + RESERVED_BYTES > free:
        raise NotEnoughDisk(
            f"{what} take about {need / 2**20:.0f} MiB; {free / 2**20:.0f} MiB are free in {folder}, "
            f"of which {RESERVED_BYTES / 2**20:.0f} MiB stay reserved"
        )


def _statistics(episodes: list[Episode], card: dict[str, Any]) -> dict[str, Any]:
    frames = np.array([episode.frames for episode in episodes])
    return {
        "episodes": len(episodes),
        "frames": int(frames.sum()),
        "frames_per_episode": [int(frames.min()), int(frames.max())],
        "particles": episodes[0].particles,
        "motions": dict(sorted(Counter(episode.motion for episode in episodes).items())),
        "repeated_attempts": sum(episode.attempt > 1 for episode in episodes),
        "rejected_tries": card["rejections"]["count"],
        "workspace_occupancy": round(card["workspace"]["occupancy"], 4),
    }
