"""Keys over their life at rest: terms, rotations, the last administrator, sessions, the audit log, file modes."""

from __future__ import annotations

import os
import stat
import threading
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

from physworld_storage.access import api_keys, audit, credentials, sessions
from physworld_storage.access.audit import LOCAL, Actor
from physworld_storage.database import Database
from physworld_storage.errors import Conflict, KeyEnded, NotFound
from physworld_storage.settings import Settings
from physworld_storage.store import open_store
from physworld_storage.tables import ApiKeyRow, AuditRow, SessionRow, utc_now

BROWSER = Actor("key_x", "192.0.2.7")


def later(monkeypatch: pytest.MonkeyPatch, by: timedelta) -> None:
    for module in (api_keys, sessions, credentials):
        monkeypatch.setattr(module, "utc_now", lambda: utc_now() + by)


def test_a_key_ends_with_its_term(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    with database.session() as session:
        key, token = api_keys.create_key(session, "robot", "write", lifetime_days=1)
        assert key.expires_at == key.created_at + timedelta(days=1)
        assert api_keys.verify(session, token) == key
        later(monkeypatch, timedelta(days=1))
        assert api_keys.verify(session, token) is None
        assert credentials.active(session, {key.credential}) == set()
        with pytest.raises(Conflict, match="expired at"):
            api_keys.rotate_key(session, key.id, timedelta(0))
        with pytest.raises(KeyEnded, match="expired at"):
            api_keys.ensure_key(session, token, "robot", "write")


def test_a_rotation_gives_the_whole_term_again(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    with database.session() as session:
        key, _ = api_keys.create_key(session, "robot", "write", lifetime_days=10)
        ever, _ = api_keys.create_key(session, "robot", "write")
        later(monkeypatch, timedelta(days=9))
        turned, _, _ = api_keys.rotate_key(session, key.id, timedelta(0))
        assert key.expires_at is not None and turned.expires_at is not None
        assert turned.expires_at - key.expires_at >= timedelta(days=9)
        assert api_keys.rotate_key(session, ever.id, timedelta(0))[0].expires_at is None


def test_a_token_that_was_rotated_away_ends_with_its_grace_and_never_comes_back(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database.session() as session:
        old = "deployment" * 4
        key = api_keys.ensure_key(session, old, "deployment", "admin")
        turned, new, until = api_keys.rotate_key(session, key.id, timedelta(minutes=5))
        assert api_keys.verify(session, old) == api_keys.verify(session, new) == turned
        with pytest.raises(KeyEnded, match="given another one by rotation"):
            api_keys.ensure_key(session, old, "deployment", "admin")
        with monkeypatch.context() as clock:
            later(clock, timedelta(minutes=5))
            assert api_keys.verify(session, old) is None
            assert api_keys.verify(session, new) == turned
            assert credentials.active(session, {key.credential, turned.credential}) == {turned.credential}
        api_keys.rotate_key(
            session, key.id, timedelta(minutes=5)
        )  # the third token: the first has no grace left
        assert api_keys.verify(session, old) is None
        assert until > utc_now()
        with pytest.raises(NotFound):
            api_keys.rotate_key(session, "key_none", timedelta(0))


def test_of_two_administrators_that_end_each_other_at_once_one_stays(database: Database) -> None:
    for _ in range(5):
        with database.session() as session:
            pair = [api_keys.create_key(session, "pair", "admin")[0] for _ in range(2)]
            mine = {key.id for key in pair}
            active = session.scalars(select(ApiKeyRow).where(api_keys.is_active(utc_now()))).all()
            for row in active:
                if row.id not in mine:
                    api_keys.revoke_key(session, row.id)
        start, refused = threading.Barrier(2), []

        def end(key_id: str, start: threading.Barrier = start, refused: list[str] = refused) -> None:
            start.wait()
            try:
                with database.session() as session:
                    api_keys.revoke_key(session, key_id)
            except Conflict as error:
                refused.append(str(error))

        threads = [threading.Thread(target=end, args=(key.id,)) for key in pair]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(refused) == 1 and "there is no other" in refused[0]
        with database.reading() as session:
            assert api_keys.count_active_admins(session) == 1


@pytest.mark.parametrize(
    ("own", "other", "may_go"),
    [
        (None, None, True),
        (None, 30, False),
        (30, None, True),
        (30, 30, True),
        (30, 60, True),
        (60, 30, False),
    ],
)
def test_the_admin_key_that_lives_longest_stays(
    database: Database, own: int | None, other: int | None, may_go: bool
) -> None:
    with database.session() as session:
        first, _ = api_keys.create_key(session, "own", "admin", lifetime_days=own)
        api_keys.create_key(session, "other", "admin", lifetime_days=other)
        api_keys.create_key(session, "writer", "write")
        if may_go:
            assert api_keys.revoke_key(session, first.id).revoked_at is not None
            api_keys.revoke_key(session, first.id)  # again is no error
        else:
            with pytest.raises(Conflict, match="lives longest"):
                api_keys.revoke_key(session, first.id)


def test_a_session_ends_with_its_key_and_an_idle_one_is_swept(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database.session() as session:
        key, _ = api_keys.create_key(session, "person", "read")
        text = sessions.begin(session, key, BROWSER)
        assert sessions.viewer(session, text) == (key, False)
        credential = api_keys.digest_of(text)
        assert credentials.key_of(session, credential) == key
        with monkeypatch.context() as clock:
            later(clock, sessions.SEEN_EVERY + timedelta(seconds=1))
            assert sessions.viewer(session, text) == (key, True)
            later(clock, sessions.IDLE)
            assert sessions.viewer(session, text) is None
            assert credentials.key_of(session, credential) is None
            sessions.begin(session, key, BROWSER)
            assert len(session.scalars(select(SessionRow)).all()) == 1
        text = sessions.begin(session, key, BROWSER)
        api_keys.revoke_key(session, key.id)
        assert sessions.viewer(session, text) is None


def test_a_session_ends_with_the_token_that_opened_it(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database.session() as session:
        key, token = api_keys.create_key(session, "person", "read")
        before = sessions.begin(session, key, BROWSER)
        turned, _, _ = api_keys.rotate_key(session, key.id, timedelta(minutes=5))
        older = api_keys.verify(session, token)
        assert older is not None
        in_grace, after = sessions.begin(session, older, BROWSER), sessions.begin(session, turned, BROWSER)
        for text in (before, in_grace):
            assert sessions.viewer(session, text) is not None
        with monkeypatch.context() as clock:
            later(clock, timedelta(minutes=5))
            for text in (before, in_grace):
                assert sessions.viewer(session, text) is None
            assert sessions.viewer(session, after) is not None
        api_keys.rotate_key(session, key.id, timedelta(0))
        assert sessions.viewer(session, after) is None


def test_the_record_is_written_with_the_change_or_not_at_all(database: Database) -> None:
    with pytest.raises(ZeroDivisionError):
        with database.session() as session:
            api_keys.create_key(session, "lost", "read")
            raise ZeroDivisionError
    with database.session() as session:
        assert session.scalars(select(AuditRow)).all() == []
        key, token = api_keys.create_key(session, "kept", "read", by=BROWSER)
        again = api_keys.ensure_key(session, token, "kept", "read", by=LOCAL)
        assert again == key
        (entry,) = audit.list_entries(session).data
    assert (entry.actor, entry.address, entry.action) == ("key_x", "192.0.2.7", "key.created")
    assert entry.subject == key.id and token not in entry.model_dump_json()


@pytest.mark.parametrize("umask", [0o022, 0o000])
def test_database_and_data_folder_are_their_owners_only(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        settings = Settings(data_dir=tmp_path / "data")
        open_store(settings)
        database = Database(settings.database_url)
        database.upgrade()
        with database.session() as session:
            api_keys.create_key(session, "x", "read")
            modes = {
                path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.glob("data/physworld*")
            }
        database.dispose()
        plain = Database(f"sqlite:///{tmp_path / 'library' / 'own.db'}")
        plain.upgrade()
        plain.dispose()
    finally:
        os.umask(before)
    assert modes == dict.fromkeys(("physworld.db", "physworld.db-wal", "physworld.db-shm"), 0o600)
    assert stat.S_IMODE((tmp_path / "data").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "library").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "library" / "own.db").stat().st_mode) == 0o600


def test_a_database_of_before_is_closed_to_others_when_it_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "physworld.db"
    Database(f"sqlite:///{path}").upgrade()
    path.chmod(0o644)
    Database(f"sqlite:///{path}").check()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
