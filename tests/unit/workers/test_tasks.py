"""The real handlers in one process: a scene becomes a fit, the fit a sealed dataset."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select
from tiny_scene import FRAMES, register, tiny_scene

from physworld.twin.twin import Twin
from physworld_schemas.dataset import Dataset, DatasetConfig
from physworld_schemas.fit import Fit, FitConfig
from physworld_schemas.job import Job
from physworld_storage import resources
from physworld_storage.clock import CLOCK
from physworld_storage.jobs import helpers, jobs, leases
from physworld_storage.tables import EpisodeRow, ShardRow
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.housekeeping import remove_orphan_episodes
from physworld_workers.stores import Stores
from physworld_workers.tasks import dataset as dataset_task
from physworld_workers.tasks import fit as fit_task
from physworld_workers.tasks.inputs import named, npz_arrays, npz_bytes
from physworld_workers.tasks.shared_runs import JOURNAL, stored_journal

pytestmark = pytest.mark.slow

EPISODES = 3


def _drain(runtime: Runtime) -> list[str]:
    """Do every shard that waits, as workers would; the outcomes."""
    outcomes = []
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return outcomes
        outcomes += [run_shard(runtime, publication.shard_id) for publication in waiting]


def _waiting(stores: Stores) -> list[str]:
    with stores.database.reading() as session:
        return [found.shard_id for found in leases.publishable(session)]


def _job(stores: Stores, job: Job) -> Job:
    with stores.database.reading() as session:
        return jobs.get_job(session, job.id)


def _make_dataset(runtime: Runtime, fit: Fit, **config: int) -> tuple[Job, Dataset]:
    with runtime.database.session() as session:
        job = jobs.create_dataset(session, fit.id, DatasetConfig(**config))
    _drain(runtime)
    with runtime.database.reading() as session:
        return _job(runtime.stores, job), resources.get_dataset(session, job.outputs[0].id)


def test_a_fit_leaves_a_twin_a_prediction_and_its_errors(fit: Fit, stores: Stores) -> None:
    assert fit.state == "ready"
    assert fit.parameters["youngs_modulus_pa"].value > 0
    assert {"static", "rigid_follow", "constant_velocity", "twin"} <= set(fit.metrics["held_out"]["track_m"])
    twin = Twin.from_arrays(
        npz_arrays(stores.artifacts.read_bytes(named(fit.artifacts, "twin.npz", fit.id).sha256))
    )
    prediction = npz_arrays(
        stores.artifacts.read_bytes(named(fit.artifacts, "prediction.npz", fit.id).sha256)
    )
    scene = tiny_scene()
    assert prediction["tracks"].shape == scene.points.shape
    assert prediction["particles"].shape == (FRAMES, len(prediction["particle_indices"]), 3)
    again = twin.simulate(*scene.control_track(), scene.times)
    shown = again[:, prediction["particle_indices"]]
    np.testing.assert_allclose(shown, prediction["particles"], atol=1e-6)  # stored in single precision
    assert fit.lineage.inputs[0].kind == "scene" and fit.lineage.config_digest


def test_a_fit_says_what_the_engine_itself_does(fit: Fit) -> None:
    assert fit.numerics is not None and fit.notes
    assert fit.numerics.refinement > 1 and fit.numerics.finer_particles > fit.numerics.particles
    assert 0 < fit.numerics.half_step_m < fit.numerics.finer_cells_m
    assert not {"numerics", "converged", "search", "notes"} & set(fit.metrics)


def test_a_fit_that_its_budget_cut_short_says_so_and_gives_no_intervals(fit: Fit) -> None:
    assert fit.search is not None and not fit.search.converged
    assert "budget of 6 simulations" in fit.search.open["youngs_modulus_pa"]
    assert fit.converged is None and "budget" in fit.not_measured
    modulus = fit.parameters["youngs_modulus_pa"]
    assert modulus.value > 0 and modulus.ci95 is None and not modulus.identified


def test_a_fit_that_ended_by_itself_has_converged_and_has_intervals(
    runtime_with, stores: Stores, scene_id: str
) -> None:
    config = FitConfig(particle_budget=60, max_simulations=120, damping="none")
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, config)
    assert _drain(runtime_with()) == ["done"]
    with stores.database.reading() as session:
        fit = resources.get_fit(session, job.outputs[0].id)
    assert fit.search is not None and fit.search.converged and fit.search.open == {}
    assert fit.converged is not None and fit.not_measured == ""
    assert {name for name, known in fit.parameters.items() if known.ci95} == set(fit.converged)


def test_a_fit_of_several_recordings_leaves_a_twin_of_each(
    runtime_with, stores: Stores, scene_id: str
) -> None:
    second = register(replace(tiny_scene(), name="again"), stores.database, stores.artifacts)
    config = FitConfig(particle_budget=60, max_simulations=120, damping="none")
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, config, scene_ids=[second])
    assert _drain(runtime_with()) == ["done"]
    with stores.database.reading() as session:
        fit = resources.get_fit(session, job.outputs[0].id)
    assert fit.scene_ids == [second] and [item.id for item in fit.lineage.inputs] == [scene_id, second]
    assert [known["scene"] for known in fit.metrics["recordings"]] == ["tiny bar", "again"]
    assert fit.metrics["recordings"][0]["held_out"]["track_m"] == fit.metrics["held_out"]["track_m"]
    (agreement,) = fit.metrics["agreement"]
    assert agreement["agrees"] and [one["scene"] for one in agreement["recordings"]] == ["tiny bar", "again"]
    files = {"twin.npz", "prediction.npz", "report.json", "twin_2.npz", "prediction_2.npz"}
    assert {artifact.name for artifact in fit.artifacts} == files
    twins = [npz_arrays(stores.artifacts.read_bytes(named(fit.artifacts, name, fit.id).sha256))
             for name in ("twin.npz", "twin_2.npz")]  # fmt: skip
    assert Twin.from_arrays(twins[0]).law == Twin.from_arrays(twins[1]).law


def test_a_fit_may_leave_its_numerics_out(runtime_with, stores: Stores, scene_id: str) -> None:
    config = FitConfig(particle_budget=60, max_simulations=6, numerics=False)
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, config)
    assert _drain(runtime_with()) == ["done"]
    with stores.database.reading() as session:
        fit = resources.get_fit(session, job.outputs[0].id)
    assert fit.numerics is None and fit.converged is None and fit.not_measured == "left out by the request"


def test_a_fit_without_damping_keeps_the_declared_physics(
    runtime_with, stores: Stores, scene_id: str
) -> None:
    config = FitConfig(particle_budget=60, max_simulations=14, damping="none")
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, config)
    assert _drain(runtime_with()) == ["done"]
    with stores.database.reading() as session:
        fit = resources.get_fit(session, job.outputs[0].id)
    assert fit.config == config and set(fit.metrics["not_needed"]) == {"poissons_ratio"}
    assert not {"air_drag_per_s", "viscosity_pa_s"} & set(fit.parameters)


def test_a_journal_in_the_scratch_belongs_to_its_payload(stores: Stores) -> None:
    first = stored_journal(stores, "job_a", {"scene_id": "a"})
    assert first.step("scan", lambda: {"cost": 1.0}) == {"cost": 1.0}
    for scene_id, cost in (("a", 1.0), ("b", 2.0)):
        again = stored_journal(stores, "job_a", {"scene_id": scene_id})
        assert again.step("scan", lambda: {"cost": 2.0}) == {"cost": cost}


def test_the_journal_of_a_fit_outlives_its_worker_and_not_the_fit(
    runtime_with, stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=6))
    (driver,) = _waiting(stores)

    class Killed(BaseException):
        pass

    def dying(*arguments: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(fit_task, "fit_report", dying)
        with pytest.raises(Killed):
            run_shard(runtime_with(), driver)
    assert stores.scratch.has(job.id, JOURNAL)
    with stores.database.session() as session:
        session.info[CLOCK] = lambda: datetime.now(UTC) + timedelta(minutes=5)
        leases.reap(session)
    simulated: list[object] = []
    monkeypatch.setattr(fit_task.SharedRunner, "__call__", lambda self, *given: simulated.append(given))
    elsewhere = Stores(stores.settings, stores.database)
    assert run_shard(replace(runtime_with(), stores=elsewhere), driver) == "done"
    assert simulated == [], "a simulation of the search was run again"
    assert stores.scratch.jobs() == []


def test_no_task_writes_below_the_data_folder(runtime_with, fit: Fit, stores: Stores) -> None:
    with pytest.raises(OSError):
        stores.settings.data_dir.mkdir(parents=True)
    job, dataset = _make_dataset(runtime_with(), fit, episodes=2, frames=8)
    assert (job.state, dataset.state) == ("succeeded", "sealed")


def test_a_dataset_is_sealed_under_the_digest_of_its_manifest(runtime_with, fit: Fit, stores: Stores) -> None:
    job, dataset = _make_dataset(runtime_with(), fit, episodes=EPISODES, frames=8, seed=7)
    assert (job.state, dataset.state) == ("succeeded", "sealed")
    assert job.progress.done == job.progress.total == EPISODES  # also what was told last
    assert dataset.statistics["episodes"] == EPISODES and dataset.statistics["frames"] == 8 * EPISODES
    assert dataset.digest is not None
    lines = []
    for line, arrays, attributes in stores.episodes.iterate(dataset.digest):
        assert arrays["particles"].shape == (8, line.particles, 3)
        assert arrays["particles"].dtype == np.float32 and arrays["times"].dtype == np.float64
        assert attributes["fit_id"] == fit.id
        lines.append(line)
    assert [line.index for line in lines] == list(range(EPISODES))
    assert len({line.seed for line in lines}) == EPISODES


def test_the_same_seed_makes_the_same_episodes(runtime_with, fit: Fit, stores: Stores) -> None:
    digests = []
    for _ in range(2):
        _, dataset = _make_dataset(runtime_with(), fit, episodes=2, frames=8, seed=11)
        with stores.database.reading() as session:
            digests.append([episode.digest for episode in resources.all_episodes(session, dataset.id)])
    assert digests[0] == digests[1]


def test_a_block_of_episodes_is_simulated_once_and_makes_the_same_demonstrations(
    runtime_with, fit: Fit, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks: list[int] = []
    make_episodes = dataset_task.make_episodes

    def counted(scene, twin, config, seeds, progress):
        blocks.append(len(seeds))
        return make_episodes(scene, twin, config, seeds, progress)

    episodes: dict[int, list[tuple[int, str]]] = {}
    for width in (1, 2):
        monkeypatch.setitem(dataset_task.WIDTHS, "cpu", width)
        monkeypatch.setattr(dataset_task, "make_episodes", counted)
        _, dataset = _make_dataset(runtime_with(), fit, episodes=3, frames=8, seed=11)
        with stores.database.reading() as session:
            made = resources.all_episodes(session, dataset.id)
        episodes[width] = [(episode.seed, episode.motion) for episode in made]
    assert blocks == [2, 1]
    assert episodes[1] == episodes[2]


def test_what_a_dead_attempt_wrote_is_removed_at_sealing(
    runtime_with, fit: Fit, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = stores.episodes.write

    def write_twice(dataset_id, index, epoch, arrays, attributes):
        write(dataset_id, index, epoch + 90, arrays, attributes)  # as an overtaken worker would have
        return write(dataset_id, index, epoch, arrays, attributes)

    monkeypatch.setattr(stores.episodes, "write", write_twice)
    job, dataset = _make_dataset(runtime_with(), fit, episodes=2, frames=8)
    assert job.state == "succeeded"
    assert stores.settings.store_folder is not None
    folder = stores.settings.store_folder / "datasets" / dataset.id / "episodes"
    with stores.database.reading() as session:
        kept = {Path(episode.path).name for episode in resources.all_episodes(session, dataset.id)}
    assert {path.name for path in folder.iterdir()} == kept


def test_a_damaged_episode_is_found_before_sealing(
    runtime_with, fit: Fit, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = stores.episodes.write

    def write_and_lie(*arguments):
        path, _ = write(*arguments)
        return path, "0" * 64

    monkeypatch.setattr(stores.episodes, "write", write_and_lie)
    job, dataset = _make_dataset(runtime_with(), fit, episodes=2, frames=8)
    assert (job.state, dataset.state) == ("failed", "failed")
    assert job.error is not None and job.error.code == "episode_corrupt"


def test_a_dataset_with_a_missing_episode_is_not_sealed(runtime_with, fit: Fit, stores: Stores) -> None:
    runtime = runtime_with()
    with stores.database.session() as session:
        job = jobs.create_dataset(session, fit.id, DatasetConfig(episodes=2, frames=8))
    for _ in range(2):  # plan, then episodes
        with stores.database.reading() as session:
            waiting = leases.publishable(session)
        for publication in waiting:
            run_shard(runtime, publication.shard_id)
    with stores.database.session() as session:
        session.delete(session.get_one(EpisodeRow, (job.outputs[0].id, 1)))
    _drain(runtime)
    error = _job(stores, job).error
    assert error is not None and error.code == "dataset_incomplete"
    assert "holds 1 episodes of 2; missing [1]" in error.detail


def test_a_dataset_that_the_disk_cannot_hold_is_refused_before_its_first_episode(
    runtime_with, fit: Fit, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset_task, "RESERVED_BYTES", 2**62)
    runtime = runtime_with()
    job, _ = _make_dataset(runtime, fit, episodes=2, frames=8)
    for _ in range(runtime.settings.max_attempts - 1):  # a disk may be full for some seconds only
        assert job.state == "running"
        with stores.database.session() as session:
            (shard,) = session.scalars(select(ShardRow).where(ShardRow.job_id == job.id))
            shard.not_before = None
        _drain(runtime)
        job = _job(stores, job)
    assert job.state == "failed" and job.error is not None
    assert job.error.code == "budget_exceeded" and "MiB are free" in job.error.detail


def test_episodes_without_a_row_go_with_a_cancelled_dataset(runtime_with, fit: Fit, stores: Stores) -> None:
    runtime = runtime_with()
    with stores.database.session() as session:
        job = jobs.create_dataset(session, fit.id, DatasetConfig(episodes=3, frames=8))
    for _ in range(2):  # the plan, then one episode
        with stores.database.reading() as session:
            run_shard(runtime, leases.publishable(session)[0].shard_id)
    dataset_id = job.outputs[0].id
    with stores.database.reading() as session:
        (committed,) = resources.all_episodes(session, dataset_id)
    folder = runtime.settings.store_folder / "datasets"
    known = (
        folder / committed.path if (folder / committed.path).exists() else next(folder.rglob("*.zarr.zip"))
    )
    orphan = known.with_name("2-e9.zarr.zip")
    orphan.write_bytes(known.read_bytes())
    assert remove_orphan_episodes(runtime.settings, stores.database) == []  # it is still written
    with stores.database.session() as session:
        jobs.cancel_job(session, job.id)
    assert len(remove_orphan_episodes(runtime.settings, stores.database)) == 1
    assert known.exists() and not orphan.exists()


def test_an_episode_that_a_stopped_worker_wrote_after_the_seal_goes(
    runtime_with, fit: Fit, stores: Stores
) -> None:
    runtime = runtime_with()
    with stores.database.session() as session:
        job = jobs.create_dataset(session, fit.id, DatasetConfig(episodes=2, frames=8))
    _drain(runtime)
    assert _job(stores, job).state == "succeeded"
    with stores.database.reading() as session:
        first, second = resources.all_episodes(session, job.outputs[0].id)
    store = runtime.settings.store_folder
    late = (store / first.path).with_name("00000-e9.zarr.zip")
    late.write_bytes((store / first.path).read_bytes())
    assert remove_orphan_episodes(runtime.settings, stores.database) == []
    removed = remove_orphan_episodes(runtime.settings, stores.database, sealed=True)
    assert [(store / path) for path in removed] == [late]
    assert (store / first.path).exists() and (store / second.path).exists() and not late.exists()


def test_arrays_survive_the_npz_and_the_same_arrays_give_the_same_bytes() -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text")}
    data = npz_bytes(arrays)
    assert data == npz_bytes(arrays)
    assert str(npz_arrays(data)["b"]) == "text"


def test_a_fit_shares_its_simulations_and_finds_the_same(
    runtime_with, stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = FitConfig(particle_budget=60, max_simulations=40, damping="none", numerics=False)
    fits, helped = [], []
    for worth_s in (0.0, 1e9):
        monkeypatch.setattr(fit_task, "WORTH_SHARING_S", worth_s)
        with stores.database.session() as session:
            job = jobs.create_fit(session, scene_id, config)
        assert _drain(runtime_with()) == ["done"]
        with stores.database.reading() as session:
            fits.append(resources.get_fit(session, job.outputs[0].id))
            shards = session.query(ShardRow).where(ShardRow.job_id == job.id).all()
        helped.append([shard for shard in shards if shard.kind == helpers.SIMULATION])
    assert len(helped[0]) > 10 and {shard.state for shard in helped[0]} == {"DONE"} and helped[1] == []
    assert fits[0].parameters == fits[1].parameters
    assert fits[0].metrics["simulations"] == fits[1].metrics["simulations"]
    assert fits[0].metrics["training_loss_m"] == fits[1].metrics["training_loss_m"]
    assert stores.scratch.jobs() == []


def test_a_cancelled_fit_leaves_nothing_in_the_scratch(
    runtime_with, stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_task, "WORTH_SHARING_S", 0.0)
    with stores.database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=40))
    put = stores.scratch.put

    def cancelled_by_then(job_id: str, name: str, data: bytes) -> None:
        put(job_id, name, data)
        with stores.database.session() as session:
            jobs.cancel_job(session, job_id)

    monkeypatch.setattr(stores.scratch, "put", cancelled_by_then)
    (driver,) = _waiting(stores)
    assert run_shard(runtime_with(), driver) == "cancelled"
    assert _job(stores, job).state == "cancelled"
    assert stores.scratch.jobs() == []
