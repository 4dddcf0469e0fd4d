"""API keys at rest, and answers that are given once."""

from __future__ import annotations

import threading
from datetime import timedelta

import pytest
from sqlalchemy import select

from physworld_storage import idempotency
from physworld_storage.access import api_keys, credentials
from physworld_storage.database import Database
from physworld_storage.errors import Conflict, IdempotencyMismatch, KeyEnded, NotFound
from physworld_storage.idempotency import Answer, fingerprint
from physworld_storage.tables import ApiKeyRow, utc_now

ANSWER = Answer(202, {"Location": "/v1/jobs/job_1"}, b'{"id": "job_1"}')
REQUEST = fingerprint("post", "/v1/fits", b"{}")


def test_a_key_is_known_by_its_token_until_it_is_revoked(database: Database) -> None:
    with database.session() as session:
        key, token = api_keys.create_key(session, "laptop", "write")
    with database.session() as session:
        assert api_keys.verify(session, token) == key
        assert credentials.key_of(session, key.credential) == key
        assert api_keys.verify(session, token + "x") is None
        assert api_keys.verify(session, "") is None
        api_keys.revoke_key(session, key.id)
        assert api_keys.verify(session, token) is None
        assert credentials.key_of(session, key.credential) is None
        assert api_keys.list_keys(session).data[0].revoked_at is not None
        with pytest.raises(NotFound):
            api_keys.revoke_key(session, "key_none")


def test_the_token_itself_is_nowhere_in_the_database(database: Database) -> None:
    with database.session() as session:
        _, token = api_keys.create_key(session, "laptop", "read")
    with database.reading() as session:
        row = session.scalars(select(ApiKeyRow)).one()
        assert not any(token in str(value) for value in vars(row).values())


def test_tokens_are_long_and_never_the_same(database: Database) -> None:
    with database.session() as session:
        tokens = {api_keys.create_key(session, "many", "read")[1] for _ in range(20)}
    assert len(tokens) == 20
    assert min(map(len, tokens)) >= 40


@pytest.mark.parametrize(
    ("role", "may"), [("read", {"read"}), ("write", {"read", "write"}), ("admin", {"read", "write", "admin"})]
)
def test_a_role_holds_those_below_it(database: Database, role: api_keys.Role, may: set[str]) -> None:
    with database.session() as session:
        key, _ = api_keys.create_key(session, "x", role)
    assert {wanted for wanted in api_keys.ROLES if key.allows(wanted)} == may


def test_a_deployments_own_token_is_registered_once(database: Database) -> None:
    token = "t" * 40
    with database.session() as session:
        first = api_keys.ensure_key(session, token, "compose", "admin")
        assert api_keys.ensure_key(session, token, "compose", "admin") == first
        with pytest.raises(Conflict, match="of role admin, not read"):
            api_keys.ensure_key(session, token, "compose", "read")
        with pytest.raises(Conflict, match="a token of 5 characters"):
            api_keys.ensure_key(session, "short", "compose", "admin")
        api_keys.create_key(session, "another", "admin")
        api_keys.revoke_key(session, first.id)
        with pytest.raises(KeyEnded, match="revoked"):
            api_keys.ensure_key(session, token, "compose", "admin")


def test_the_first_answer_is_repeated(database: Database) -> None:
    with database.session() as session:
        assert idempotency.reserve(session, "key_1", "abc", REQUEST) is None
        idempotency.record(session, "key_1", "abc", ANSWER)
    with database.session() as session:
        assert idempotency.reserve(session, "key_1", "abc", REQUEST) == ANSWER
        assert idempotency.reserve(session, "key_2", "abc", REQUEST) is None


def test_another_request_under_the_same_key_is_refused(database: Database) -> None:
    with database.session() as session:
        idempotency.reserve(session, "key_1", "abc", REQUEST)
        idempotency.record(session, "key_1", "abc", ANSWER)
    with database.session() as session, pytest.raises(IdempotencyMismatch, match="'abc'"):
        idempotency.reserve(session, "key_1", "abc", fingerprint("POST", "/v1/fits", b"[]"))
    assert fingerprint("POST", "/v1/fits", b"{}") == REQUEST


def test_work_that_breaks_gives_the_key_back(database: Database) -> None:
    with pytest.raises(ZeroDivisionError):
        with database.session() as session:
            idempotency.reserve(session, "key_1", "abc", REQUEST)
            raise ZeroDivisionError
    with database.session() as session:
        assert idempotency.reserve(session, "key_1", "abc", REQUEST) is None


def test_of_two_at_the_same_time_one_works_and_both_get_its_answer(database: Database) -> None:
    barrier = threading.Barrier(4)
    worked: list[int] = []
    answers: list[Answer] = []

    def post(number: int) -> None:
        barrier.wait()
        with database.session() as session:
            answer = idempotency.reserve(session, "key_1", "abc", REQUEST)
            if answer is None:
                worked.append(number)
                answer = Answer(201, {}, str(number).encode())
                idempotency.record(session, "key_1", "abc", answer)
        answers.append(answer)

    threads = [threading.Thread(target=post, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(worked) == 1
    assert {answer.body for answer in answers} == {str(worked[0]).encode()}


def test_old_keys_are_forgotten(database: Database) -> None:
    with database.session() as session:
        idempotency.reserve(session, "key_1", "abc", REQUEST)
        idempotency.record(session, "key_1", "abc", ANSWER)
        assert idempotency.forget(session, utc_now() - timedelta(days=1)) == 0
        assert idempotency.forget(session, utc_now() + timedelta(seconds=1)) == 1


def test_large_answers_are_forgotten_before_small_ones(database: Database) -> None:
    """Those of rollouts have some MiB each, and nobody asks for them again after minutes."""
    large = Answer(200, {}, b"x" * 1001)
    with database.session() as session:
        for key, answer in (("small", ANSWER), ("large", large)):
            idempotency.reserve(session, "key_1", key, REQUEST)
            idempotency.record(session, "key_1", key, answer)
        soon = utc_now() + timedelta(seconds=1)
        assert idempotency.forget(session, utc_now() - timedelta(days=1), 1000) == 0
        assert idempotency.forget(session, soon, 1001) == 0
        assert idempotency.forget(session, soon, 1000) == 1
        assert idempotency.reserve(session, "key_1", "small", REQUEST) == ANSWER
        assert idempotency.reserve(session, "key_1", "large", REQUEST) is None


@pytest.mark.parametrize("key", ["", "k" * 256])
def test_a_key_without_sense_is_refused(database: Database, key: str) -> None:
    with database.session() as session, pytest.raises(Conflict, match="1 to 255 are allowed"):
        idempotency.reserve(session, "key_1", key, REQUEST)
