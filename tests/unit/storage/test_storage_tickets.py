"""Tickets: good once, for one purpose, for a minute, as long as their key is."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

from physworld_storage.access import api_keys, tickets
from physworld_storage.database import Database, open_database
from physworld_storage.settings import Settings
from physworld_storage.tables import TicketRow, utc_now


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Database]:
    database = open_database(Settings(data_dir=tmp_path / "data"))
    database.upgrade()
    yield database
    database.dispose()


def test_a_ticket_is_good_once_and_for_its_purpose(opened: Database) -> None:
    with opened.session() as session:
        key, _ = api_keys.create_key(session, "robot", "write")
        ticket, until = tickets.issue(session, key.credential, "live:beam:1")
        assert utc_now() < until <= utc_now() + tickets.LIFETIME
        assert ticket not in {row.digest for row in session.scalars(select(TicketRow))}
    with opened.session() as session:
        assert tickets.redeem(session, ticket, "live:beam:2") is None
        found = tickets.redeem(session, ticket, "live:beam:1")
        assert found is not None
        assert found.id == key.id
    with opened.session() as session:
        assert tickets.redeem(session, ticket, "live:beam:1") is None
        assert tickets.redeem(session, "made up", "live:beam:1") is None


def test_a_ticket_ends_with_its_minute_and_with_its_key(
    opened: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened.session() as session:
        key, _ = api_keys.create_key(session, "robot", "write")
        late, _ = tickets.issue(session, key.credential, "live:beam:1")
        monkeypatch.setattr(tickets, "utc_now", lambda: utc_now() + tickets.LIFETIME + timedelta(seconds=1))
        assert tickets.redeem(session, late, "live:beam:1") is None
        other, _ = tickets.issue(session, key.credential, "live:beam:1")  # sweeps what is over
        assert len(list(session.scalars(select(TicketRow)))) == 1
        api_keys.revoke_key(session, key.id)
        assert tickets.redeem(session, other, "live:beam:1") is None
