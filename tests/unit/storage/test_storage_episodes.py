"""The episode store: what was committed is what is read, and damage is never read as data."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import resource
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import obstore
import pytest
import zarr
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from physworld_schemas.dataset import Episode
from physworld_storage.episodes import Arrays, EpisodeStore, arrays_digest, episode_path
from physworld_storage.errors import EpisodeCorrupt, NotFound
from physworld_storage.settings import Settings
from physworld_storage.store import open_store

pytestmark = pytest.mark.slow

DATASET = "dst_01TEST"


def episode(frames: int = 12, particles: int = 20, controllers: int = 2, seed: int = 0) -> Arrays:
    chance = np.random.default_rng(seed)
    return {
        "times": np.arange(frames) / 30.0,
        "particles": chance.normal(size=(frames, particles, 3)).astype(np.float32),
        "controllers": chance.normal(size=(frames, controllers, 3)).astype(np.float32),
        "properties": np.zeros((particles, 2), dtype=np.float32),
    }


@pytest.fixture
def episodes(store_settings: Settings) -> EpisodeStore:
    return EpisodeStore(store_settings)


@pytest.fixture
def local(tmp_path: Path) -> EpisodeStore:
    return EpisodeStore(Settings(data_dir=tmp_path))


def test_what_was_written_is_read_again(episodes: EpisodeStore) -> None:
    wanted = episode()
    path, digest = episodes.write(DATASET, 3, 2, wanted, {"seed": 7, "motion": "lift"})
    assert path == f"datasets/{DATASET}/episodes/00003-e2.zarr.zip"
    assert digest == arrays_digest(wanted)
    found, attributes = episodes.read(path, digest)
    assert attributes == {"seed": 7, "motion": "lift"}
    assert set(found) == set(wanted)
    for name, array in wanted.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_a_part_is_read_and_verified_alone(local: EpisodeStore, tmp_path: Path) -> None:
    wanted = episode()
    path, digest = local.write(DATASET, 0, 1, wanted, {"seed": 7})
    found, attributes = local.verified(path, digest, ("times", "controllers", "vertices"))
    assert set(found) == {"times", "controllers"} and attributes == {"seed": 7}
    np.testing.assert_array_equal(found["controllers"], wanted["controllers"])
    _change(tmp_path / "store" / path, "particles/c/0/0/0", lambda _: b"damaged")
    assert set(local.verified(path, digest, ("times",))[0]) == {"times"}
    with pytest.raises(EpisodeCorrupt):
        local.verified(path, digest)
    other = local.write(DATASET, 0, 2, episode(seed=1), {})[0]
    with zipfile.ZipFile(tmp_path / "store" / other) as archive:
        header = archive.read("zarr.json")
    _change(tmp_path / "store" / path, "zarr.json", lambda _: header)  # its parts are another episode's
    with pytest.raises(EpisodeCorrupt, match="committed was"):
        local.verified(path, digest, ("times",))


def test_a_part_that_was_changed_is_noticed(local: EpisodeStore, tmp_path: Path) -> None:
    path, digest = local.write(DATASET, 0, 1, episode(), {})
    _change(tmp_path / "store" / path, "controllers/c/0/0/0", lambda data: bytes(4) + data[4:])
    with pytest.raises(EpisodeCorrupt, match="controllers do not have the digest"):
        local.verified(path, digest, ("controllers",))
    assert set(local.verified(path, digest, ("times",))[0]) == {"times"}


def test_an_episode_of_the_first_format_is_read_whole(local: EpisodeStore, tmp_path: Path) -> None:
    """One digest over name, type, shape and bytes of every array, and a list of names in the header."""
    wanted = episode()
    path = f"datasets/{DATASET}/episodes/00000-e1.zarr"
    header = {"format": "physworld-episode/1", "arrays": sorted(wanted), "attributes": {"seed": 7}}
    group = zarr.create_group(tmp_path / "store" / path, attributes=header)
    digest = hashlib.sha256()
    for name in sorted(wanted):
        group.create_array(name, data=wanted[name])
        digest.update(json.dumps([name, wanted[name].dtype.str, wanted[name].shape]).encode())
        digest.update(wanted[name].tobytes())
    found, attributes = local.verified(path, digest.hexdigest())
    assert set(found) == set(wanted) and attributes == {"seed": 7}
    assert set(local.verified(path, digest.hexdigest(), ("times", "vertices"))[0]) == {"times"}
    with pytest.raises(EpisodeCorrupt, match="committed was"):
        local.verified(path, arrays_digest(wanted))


def test_attributes_that_have_rotted_are_noticed_and_no_part_of_the_digest(
    local: EpisodeStore, tmp_path: Path
) -> None:
    noted = {
        "effect_strengths": {"air_drag_linear": 0.25},
        "counts": {2: "b", 10: "a"},
        "range": (1.5, 2.5e-7),
    }
    path, digest = local.write(DATASET, 0, 1, episode(), noted)
    assert digest == arrays_digest(episode())
    local.verify(path, digest)
    file = tmp_path / "store" / path
    _change(file, "zarr.json", lambda text: text.replace(b"0.25", b"0.35"))
    with pytest.raises(EpisodeCorrupt, match="its attributes do not have the digest"):
        local.verify(path, digest)

    def without_digest(text: bytes) -> bytes:
        header = json.loads(text)
        del header["attributes"]["attributes_sha256"]
        return json.dumps(header).encode()

    _change(file, "zarr.json", without_digest)
    assert local.verified(path, digest)[1]["effect_strengths"] == {"air_drag_linear": 0.35}, (
        "an older episode"
    )


def test_an_episode_without_controllers_is_kept(episodes: EpisodeStore) -> None:
    path, digest = episodes.write(DATASET, 0, 1, episode(controllers=0), {})
    episodes.verify(path, digest)
    assert episodes.read(path)[0]["controllers"].shape == (12, 0, 3)


def test_an_episode_is_one_file_that_zarr_itself_opens(local: EpisodeStore, tmp_path: Path) -> None:
    wanted = episode(frames=101, particles=3000)
    path, digest = local.write(DATASET, 0, 1, wanted, {"seed": 7})
    local.verify(path, digest)
    assert [file for file in (tmp_path / "store").rglob("*") if file.is_file()] == [tmp_path / "store" / path]
    with zarr.storage.ZipStore(tmp_path / "store" / path, mode="r") as store:
        group = zarr.open_group(store, mode="r")
        assert group.attrs["attributes"] == {"seed": 7}
        np.testing.assert_array_equal(group["particles"][50:60], wanted["particles"][50:60])
    with zipfile.ZipFile(tmp_path / "store" / path) as archive:  # a header and one shard for each array
        assert len(archive.namelist()) == 1 + 2 * len(wanted)


def test_a_part_of_an_episode_is_read_by_two_requests(
    store_settings: Settings, episodes: EpisodeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of the file, with all headers and small arrays, and the large array that is asked for."""
    wanted = episode(frames=300, particles=500)
    wanted["vertices"] = np.random.default_rng(1).normal(size=(300, 100, 3)).astype(np.float32)
    path, digest = episodes.write(DATASET, 0, 1, wanted, {})
    asked = []
    for name in ("get", "get_range", "head"):

        def counted(*given: Any, name: str = name, real: Any = getattr(obstore, name), **options: Any) -> Any:
            asked.append(name)
            return real(*given, **options)

        monkeypatch.setattr(obstore, name, counted)
    found, _ = episodes.verified(path, digest, ("times", "controllers", "vertices"))
    assert set(found) == {"times", "controllers", "vertices"}
    assert asked == ["get", "get_range"]


def test_the_same_episode_is_the_same_file(local: EpisodeStore, tmp_path: Path) -> None:
    first, second = (local.write(DATASET, 0, epoch, episode(), {"seed": 7})[0] for epoch in (1, 2))
    assert (tmp_path / "store" / first).read_bytes() == (tmp_path / "store" / second).read_bytes()


def test_an_episode_that_is_a_folder_is_read_and_removed_as_ever(
    episodes: EpisodeStore, store_settings: Settings
) -> None:
    """What was written before an episode was one file: a file for each array and each header."""
    wanted, path = episode(), f"datasets/{DATASET}/episodes/00000-e1.zarr"
    made = [episodes.write(DATASET, 0, 2, wanted, {"seed": 7})]
    folder = open_store(store_settings, path)
    with zipfile.ZipFile(io.BytesIO(_content(store_settings, made[0][0]))) as archive:
        for name in archive.namelist():
            obstore.put(folder, name, archive.read(name))
    found, attributes = episodes.verified(path, made[0][1])
    assert set(found) == set(wanted) and attributes == {"seed": 7}
    assert set(episodes.verified(path, made[0][1], ("times",))[0]) == {"times"}
    assert episodes.remove_orphans(DATASET, [made[0][0]]) == [path]
    with pytest.raises(NotFound):
        episodes.read(path)
    episodes.verify(*made[0])


def test_what_a_killed_writer_leaves_goes_with_the_orphans(local: EpisodeStore, tmp_path: Path) -> None:
    path, digest = local.write(DATASET, 0, 2, episode(), {})
    left = tmp_path / "store" / episode_path(DATASET, 0, 1)
    left = left.with_name(f"{left.name}#1")  # the name that the store gives a file until it is whole
    left.write_bytes(b"half")
    assert local.remove_orphans(DATASET, [path]) == []
    assert not left.exists()
    local.verify(path, digest)


def test_writing_an_attempt_again_replaces_it(episodes: EpisodeStore) -> None:
    episodes.write(DATASET, 0, 1, episode(frames=40, seed=1), {"old": True})
    path, digest = episodes.write(DATASET, 0, 1, episode(seed=2), {})
    assert episodes.read(path, digest)[1] == {}


def test_another_digest_is_refused(episodes: EpisodeStore) -> None:
    path, _ = episodes.write(DATASET, 0, 1, episode(seed=1), {})
    with pytest.raises(EpisodeCorrupt, match="committed was"):
        episodes.verify(path, arrays_digest(episode(seed=2)))


def test_what_is_not_there_is_not_found(episodes: EpisodeStore) -> None:
    with pytest.raises(NotFound):
        episodes.read(episode_path(DATASET, 0, 1))
    with pytest.raises(EpisodeCorrupt, match="is gone"):
        episodes.verify(episode_path(DATASET, 0, 1), "0" * 64)
    with pytest.raises(NotFound):
        episodes.read("../../etc")
    with pytest.raises(ValueError, match="not the id of a dataset"):
        episodes.write("../x", 0, 1, episode(), {})


def test_what_is_no_number_is_refused_before_anything_is_written(local: EpisodeStore, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="array names is"):
        local.write(DATASET, 0, 1, {"names": np.array(["a"])}, {})
    assert not (tmp_path / "store" / "datasets").exists()


@given(kept=st.floats(0.0, 0.999), which=st.sampled_from(["particles", "controllers", "times"]))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_shard_is_noticed(local: EpisodeStore, tmp_path: Path, kept: float, which: str) -> None:
    path, digest = local.write(DATASET, 0, 1, episode(), {})
    _change(tmp_path / "store" / path, f"{which}/c/0", lambda data: data[: int(kept * len(data))])
    with pytest.raises(EpisodeCorrupt):
        local.verify(path, digest)


@given(kept=st.floats(0.0, 0.999))
@example(kept=0.0)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_file_is_noticed(local: EpisodeStore, tmp_path: Path, kept: float) -> None:
    path, digest = local.write(DATASET, 0, 1, episode(), {})
    file = tmp_path / "store" / path
    data = file.read_bytes()
    file.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(EpisodeCorrupt):
        local.verify(path, digest)


def test_an_episode_is_written_where_an_event_loop_runs(local: EpisodeStore) -> None:
    async def write() -> tuple[str, str]:
        return local.write(DATASET, 0, 1, episode(), {})

    path, digest = asyncio.run(write())
    local.verify(path, digest)


@given(
    name=st.sampled_from(["particles/c/0/0/0", "particles/zarr.json", "zarr.json", ""]),
    place=st.floats(0.0, 0.999),
    bit=st.integers(0, 7),
)
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_flipped_bit_never_changes_what_is_read(
    local: EpisodeStore, tmp_path: Path, name: str, place: float, bit: int
) -> None:
    """In a member whose checksum was made to fit, or anywhere in the file."""

    def flipped(content: bytes) -> bytes:
        data = bytearray(content)
        data[int(place * len(data))] ^= 1 << bit
        return bytes(data)

    wanted = episode(frames=3, particles=5)
    path, digest = local.write(DATASET, 0, 1, wanted, {})
    file = tmp_path / "store" / path
    if name:
        _change(file, name, flipped)
    else:
        file.write_bytes(flipped(file.read_bytes()))
    try:
        found, _ = local.read(path, digest)
    except (EpisodeCorrupt, NotFound):
        return
    np.testing.assert_array_equal(found["particles"], wanted["particles"])


@pytest.mark.parametrize("name", ["particles/c/0/0/0", "particles/zarr.json", "zarr.json", "particles"])
def test_a_lost_member_is_noticed(local: EpisodeStore, tmp_path: Path, name: str) -> None:
    wanted = episode()
    wanted["particles"][:] = 0
    path, digest = local.write(DATASET, 0, 1, wanted, {})
    _change(tmp_path / "store" / path, name, lambda _: None)
    with pytest.raises(EpisodeCorrupt):
        local.verify(path, digest)


@pytest.mark.parametrize("text", ["", "{}", "null", '{"zarr_format": 3, "node_type": "group"}', "\xff"])
def test_damaged_metadata_is_noticed(local: EpisodeStore, tmp_path: Path, text: str) -> None:
    path, digest = local.write(DATASET, 0, 1, episode(), {})
    _change(tmp_path / "store" / path, "zarr.json", lambda _: text.encode("latin-1"))
    with pytest.raises(EpisodeCorrupt):
        local.verify(path, digest)


@given(
    array=arrays_of.arrays(
        dtype=st.sampled_from([np.float32, np.float64, np.int32, np.uint8, np.bool_]),
        shape=arrays_of.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=5),
    )
)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_array_of_numbers_survives(local: EpisodeStore, array: np.ndarray) -> None:
    path, digest = local.write(DATASET, 0, 1, {"x": array}, {})
    found = local.read(path, digest)[0]["x"]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


def test_the_digest_knows_names_types_shapes_and_bytes() -> None:
    base = np.arange(6, dtype=np.float32)
    others = [
        {"y": base},
        {"x": base.astype(np.float64)},
        {"x": base.reshape(2, 3)},
        {"x": -base},
        {"x": base, "y": base},
    ]
    digests = {arrays_digest(arrays) for arrays in [{"x": base}, *others]}
    assert len(digests) == 6
    assert arrays_digest({"x": base.astype(">f4")}) == arrays_digest({"x": base})
    assert arrays_digest({"x": np.stack([base, base])[:, ::2]}) == arrays_digest(
        {"x": np.stack([base[::2], base[::2]])}
    )


def test_a_sealed_dataset_is_read_through_its_manifest(episodes: EpisodeStore) -> None:
    committed = [_commit(episodes, index) for index in (2, 0, 1)]
    manifest = episodes.write_manifest(DATASET, committed)
    assert (manifest.name, manifest.media_type) == ("manifest.json", "application/json")
    read = [
        (line.index, line.seed, arrays["particles"]) for line, arrays, _ in episodes.iterate(manifest.sha256)
    ]
    assert [(index, seed) for index, seed, _ in read] == [(0, 0), (1, 1), (2, 2)]
    np.testing.assert_array_equal(read[1][2], episode(seed=1)["particles"])
    assert episodes.write_manifest(DATASET, reversed(committed)).sha256 == manifest.sha256


def test_a_damaged_episode_stops_the_reading_of_its_dataset(local: EpisodeStore, tmp_path: Path) -> None:
    committed = [_commit(local, index) for index in range(2)]
    manifest = local.write_manifest(DATASET, committed)
    _change(tmp_path / "store" / committed[1].path, "particles/c", lambda _: None)
    found = local.iterate(manifest.sha256)
    assert next(found)[0].index == 0
    with pytest.raises(EpisodeCorrupt, match="00001-e1"):
        next(found)


def test_orphans_go_and_the_committed_stay(episodes: EpisodeStore) -> None:
    kept, digest = episodes.write(DATASET, 0, 2, episode(), {})
    orphans = [episodes.write(DATASET, 0, epoch, episode(), {})[0] for epoch in (1, 20)]
    other, other_digest = episodes.write("dst_01OTHER", 0, 1, episode(), {})
    assert episodes.remove_orphans(DATASET, [kept]) == sorted(orphans)
    assert episodes.remove_orphans(DATASET, [kept]) == []
    episodes.verify(kept, digest)
    episodes.verify(other, other_digest)
    for orphan in orphans:
        with pytest.raises(NotFound):
            episodes.read(orphan)


FILL = """
import sys, numpy as np
from physworld_storage.episodes import EpisodeStore
from physworld_storage.errors import StoreFull
from physworld_storage.settings import Settings
from physworld_storage.store import open_store
store = EpisodeStore(Settings(data_dir=sys.argv[1]))
noise = np.random.default_rng(0).random((64, 4096, 3)).astype(np.float32)
try:
    store.write("dst_01FULL", 0, 1, {"particles": noise}, {})
except StoreFull as error:
    print(error)
"""


def test_a_full_disk_is_said_plainly_and_leaves_nothing(tmp_path: Path, repository: Path) -> None:
    """A limit on the size of a file makes the kernel refuse the write, as a full disk does."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))

    done = subprocess.run(
        [sys.executable, "-c", FILL, str(tmp_path)],
        cwd=repository,
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (
        "episode datasets/dst_01FULL/episodes/00000-e1.zarr.zip, 3145728 bytes, was not written"
        in done.stdout
    )
    assert "bytes are free" in done.stdout
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []


def _commit(store: EpisodeStore, index: int) -> Episode:
    path, digest = store.write(DATASET, index, 1, episode(seed=index), {})
    return Episode(index=index, path=path, digest=digest, seed=index, frames=12, particles=20)


def _content(settings: Settings, path: str) -> bytes:
    return bytes(obstore.get(open_store(settings), path).bytes())


def _change(file: Path, name: str, change: Callable[[bytes], bytes | None]) -> None:
    """Replace the members of a ZIP whose name begins so, or leave them out where ``change`` gives None."""
    with zipfile.ZipFile(file) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    with zipfile.ZipFile(file, "w") as archive:
        for member, content in members.items():
            changed = change(content) if member.startswith(name) else content
            if changed is not None:
                archive.writestr(member, changed)
