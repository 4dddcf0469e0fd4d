"""The queue application: what it must be set to, and what must not be imported before a fork."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pydantic import SecretStr

from physworld_schemas.queues import INFERENCE, SIMULATION, TASK_NAME, TRAINING
from physworld_storage.jobs.kinds import SHARDS
from physworld_storage.settings import Settings
from physworld_workers.app import HARD_LIMIT_S, create_app
from physworld_workers.errors import UnknownShardKind
from physworld_workers.execute import handler_of

pytestmark = pytest.mark.slow


@pytest.fixture
def settings(tmp_path) -> Settings:
    return Settings(data_dir=tmp_path, broker_url=SecretStr("redis://:secret@127.0.0.1:1/0"))


def test_messages_outlive_workers_and_never_run_beside_themselves(settings: Settings) -> None:
    conf = create_app(settings).conf
    assert conf.task_acks_late and conf.task_reject_on_worker_lost
    assert conf.worker_prefetch_multiplier == 1
    assert conf.broker_transport_options["visibility_timeout"] > conf.task_time_limit == HARD_LIMIT_S
    assert conf.task_soft_time_limit < conf.task_time_limit


def test_only_json_is_accepted_and_no_result_is_kept(settings: Settings) -> None:
    conf = create_app(settings).conf
    assert conf.accept_content == ["json"] and conf.task_serializer == "json"
    assert conf.task_ignore_result


def test_each_queue_has_a_route_of_its_own(settings: Settings) -> None:
    queues = create_app(settings).conf.task_queues
    assert {(queue.name, queue.routing_key) for queue in queues} == {
        (SIMULATION, SIMULATION),
        (TRAINING, TRAINING),
        (INFERENCE, INFERENCE),
    }


def test_the_one_task_has_the_name_that_is_published(settings: Settings) -> None:
    assert TASK_NAME in create_app(settings).tasks


def test_an_application_needs_a_broker(tmp_path) -> None:
    with pytest.raises(ValueError, match="PHYSWORLD_BROKER_URL"):
        create_app(Settings(data_dir=tmp_path))


@pytest.mark.parametrize(
    "module",
    ["physworld_workers.__main__", "physworld_workers.dispatcher", "physworld_services.trainer.__main__"],
)
def test_neither_torch_nor_warp_is_loaded_when_a_worker_starts(module: str) -> None:
    code = (
        f"import sys, {module}, physworld_workers.app, physworld_workers.execute\n"
        "from pydantic import SecretStr; from physworld_storage.settings import Settings\n"
        "physworld_workers.app.create_app(Settings(broker_url=SecretStr('redis://127.0.0.1:1/0')))\n"
        "loaded = {'torch', 'warp'} & set(sys.modules)\n"
        "assert not loaded, loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_kind_that_there_is_not_is_named() -> None:
    with pytest.raises(UnknownShardKind, match="'rendering'"):
        handler_of("rendering")


def test_every_handler_can_be_imported() -> None:
    for kind in SHARDS:
        assert callable(handler_of(kind))
