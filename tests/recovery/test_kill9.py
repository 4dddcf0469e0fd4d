"""kill -9 of worker, broker and whole service in the middle of a dataset loses and doubles nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from service_process import ServiceProcess, until, wait_for_job
from tiny_scene import register, tiny_scene

from physworld_schemas.dataset import DatasetConfig, Episode
from physworld_schemas.fit import FitConfig
from physworld_storage import resources
from physworld_storage.database import Database
from physworld_storage.jobs import jobs

EPISODES = 40
FRAMES = 60
JOB_WITHIN_S = 240.0


def _episodes(database: Database, dataset_id: str) -> list[Episode]:
    with database.reading() as session:
        return resources.all_episodes(session, dataset_id)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_forty_episodes_survive_three_kills(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--no-trainer") as service:
        service.start()
        database, stores = service.stores()
        scene_id = register(tiny_scene(), database, stores.artifacts)
        with database.session() as session:
            fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=400, max_simulations=4))
        wait_for_job(database, fit.id, JOB_WITHIN_S)
        with database.session() as session:
            config = DatasetConfig(episodes=EPISODES, frames=FRAMES)
            job = jobs.create_dataset(session, fit.outputs[0].id, config)
        dataset_id = job.outputs[0].id

        def at_least(count: int) -> None:
            until(lambda: len(_episodes(database, dataset_id)) >= count, f"{count} episodes", JOB_WITHIN_S)

        at_least(3)
        service.kill_child("worker-1")
        at_least(10)
        service.kill_child("broker")
        at_least(17)
        service.kill()
        committed_before = {episode.index: episode for episode in _episodes(database, dataset_id)}
        assert 17 <= len(committed_before) < EPISODES

        service.start()
        wait_for_job(database, job.id, JOB_WITHIN_S)
        episodes = _episodes(database, dataset_id)
        assert [episode.index for episode in episodes] == list(range(EPISODES))
        assert len({episode.digest for episode in episodes}) == EPISODES
        for episode in episodes:
            stores.episodes.verify(episode.path, episode.digest)
            assert committed_before.get(episode.index, episode) == episode
        folder = tmp_path / "data" / "store" / "datasets" / dataset_id / "episodes"
        assert sorted(path.name for path in folder.iterdir()) == [
            Path(episode.path).name for episode in episodes
        ]
        with database.reading() as session:
            dataset = resources.get_dataset(session, dataset_id)
        assert dataset.state == "sealed" and dataset.digest is not None
        manifest = stores.episodes.read_manifest(dataset.digest)
        assert [(line.path, line.digest) for line in manifest.episodes] == [
            (episode.path, episode.digest) for episode in episodes
        ]
        assert service.interrupt() == 0
        database.dispose()
