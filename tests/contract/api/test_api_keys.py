"""Keys over their life: the last administrator, terms, rotation, the audit log, too many attempts."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from api_service import Service, assert_problem
from conftest import serve

from physworld_services.api import attempts
from physworld_storage.access import api_keys
from physworld_storage.settings import Settings


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """A service of its own for each test: keys are counted, and so are attempts."""
    yield from serve(Settings(data_dir=tmp_path / "data"))


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


@contextmanager
def admin(service: Service) -> Iterator[tuple[httpx.Client, str]]:
    """A client with the only admin key, which never ends, and the key's id."""
    with service.client() as client:
        yield client, client.get("/v1/keys").json()["data"][0]["id"]


def test_the_last_administrator_cannot_end_its_own_key(service: Service) -> None:
    with admin(service) as (client, own):
        refused = assert_problem(client.delete(f"/v1/keys/{own}"), 409, "conflict")
        assert "there is no other" in refused["detail"] and "Make another admin key" in refused["detail"]
        assert client.get("/v1/keys").status_code == 200


def test_an_administrator_whose_key_ends_earlier_is_no_replacement(service: Service) -> None:
    with admin(service) as (client, own):
        client.post("/v1/keys", json={"name": "for a year", "role": "admin"})
        client.post("/v1/keys", json={"name": "writes", "role": "write", "expires_in_days": None})
        refused = assert_problem(client.delete(f"/v1/keys/{own}"), 409, "conflict")
        assert "1 others end before it" in refused["detail"]
        client.post("/v1/keys", json={"name": "for ever", "role": "admin", "expires_in_days": None})
        assert client.delete(f"/v1/keys/{own}").status_code == 200
        assert_problem(client.get("/v1/keys"), 401, "unauthenticated")


def test_two_administrators_that_end_each_other_at_once_leave_one(service: Service) -> None:
    for _ in range(10):
        with service.database.session() as session:
            pair = [api_keys.create_key(session, "pair", "admin") for _ in range(2)]
            for key in api_keys.list_keys(session).data:
                if key.id not in {made.id for made, _ in pair} and key.revoked_at is None:
                    api_keys.revoke_key(session, key.id)
        start, statuses = threading.Barrier(2), []

        def end(token: str, other: str, start: threading.Barrier = start, statuses: list = statuses) -> None:
            with service.client(None) as client:
                start.wait()
                statuses.append(client.delete(f"/v1/keys/{other}", headers=bearer(token)).status_code)

        threads = [
            threading.Thread(target=end, args=(pair[turn][1], pair[1 - turn][0].id)) for turn in (0, 1)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(statuses) in ([200, 401], [200, 409])
        with service.database.reading() as session:
            assert api_keys.count_active_admins(session) == 1


def test_a_key_lasts_a_year_unless_told_otherwise(service: Service) -> None:
    with service.client() as client:
        made = client.post("/v1/keys", json={"name": "robot"}).json()
        left = datetime.fromisoformat(made["expires_at"]) - datetime.now(UTC)
        assert timedelta(days=364) < left <= timedelta(days=365)
        for days, end in ((None, None), (30, timedelta(days=30))):
            key = client.post("/v1/keys", json={"name": "robot", "expires_in_days": days}).json()
            if end is None:
                assert key["expires_at"] is None
            else:
                assert datetime.fromisoformat(key["expires_at"]) - datetime.now(UTC) <= end
        assert_problem(
            client.post("/v1/keys", json={"name": "x", "expires_in_days": 0}), 422, "invalid_request"
        )


def test_an_expired_key_opens_nothing(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    with service.client() as client, service.client(None) as robot:
        token = client.post("/v1/keys", json={"name": "robot", "expires_in_days": 1}).json()["token"]
        assert robot.get("/v1/jobs", headers=bearer(token)).status_code == 200
        tomorrow = datetime.now(UTC) + timedelta(days=1, seconds=5)
        monkeypatch.setattr(api_keys, "utc_now", lambda: tomorrow)
        refused = assert_problem(robot.get("/v1/jobs", headers=bearer(token)), 401, "unauthenticated")
        assert "expired" in refused["detail"]


def test_a_rotated_key_has_another_token_and_its_old_one_for_the_grace(service: Service) -> None:
    with service.client() as client, service.client(None) as robot:
        made = client.post("/v1/keys", json={"name": "robot"}).json()
        turned = client.post(f"/v1/keys/{made['id']}/rotate", json={"grace_minutes": 5})
        assert turned.status_code == 200
        new = turned.json()
        assert new["id"] == made["id"] and new["token"] != made["token"]
        assert new["expires_at"] > made["expires_at"]
        assert datetime.fromisoformat(new["old_token_until"]) - datetime.now(UTC) <= timedelta(minutes=5)
        for token in (made["token"], new["token"]):
            assert robot.get("/v1/jobs", headers=bearer(token)).status_code == 200
        newest = client.post(f"/v1/keys/{made['id']}/rotate", json={"grace_minutes": 0}).json()
        for token, status in ((made["token"], 401), (new["token"], 401), (newest["token"], 200)):
            assert robot.get("/v1/jobs", headers=bearer(token)).status_code == status


def test_a_rotation_that_is_repeated_is_one_and_shows_no_token_again(service: Service) -> None:
    with service.client() as client:
        made = client.post("/v1/keys", json={"name": "robot"}).json()
        once = {"Idempotency-Key": "turn"}
        first = client.post(f"/v1/keys/{made['id']}/rotate", headers=once).json()
        again = client.post(f"/v1/keys/{made['id']}/rotate", headers=once)
        assert again.headers["Idempotent-Replayed"] == "true"
        assert again.json() == {**first, "token": None}
        client.delete(f"/v1/keys/{made['id']}")
        assert_problem(client.post(f"/v1/keys/{made['id']}/rotate"), 409, "conflict")
        assert_problem(client.post("/v1/keys/key_none/rotate"), 404, "not_found")


def test_what_was_done_to_keys_is_on_record_and_no_token_with_it(service: Service) -> None:
    with service.client() as client:
        made = client.post("/v1/keys", json={"name": "robot", "role": "write"}).json()
        new = client.post(f"/v1/keys/{made['id']}/rotate").json()
        client.delete(f"/v1/keys/{made['id']}")
        answer = client.get("/v1/audit")
        entries = answer.json()["data"]
        about = [entry for entry in entries if entry["subject"] == made["id"]]
        assert [entry["action"] for entry in about] == ["key.revoked", "key.rotated", "key.created"]
        own = client.get("/v1/keys").json()["data"][-1]["id"]
        assert {(entry["actor"], entry["address"]) for entry in about} == {(own, "127.0.0.1")}
        assert about[-1]["detail"]["role"] == "write"
        assert not [token for token in (made["token"], new["token"]) if token in answer.text]
        first = client.get("/v1/audit?limit=2").json()
        rest = client.get("/v1/audit", params={"cursor": first["next_cursor"]}).json()
        assert first["data"] + rest["data"] == entries
    with service.client("write") as writer:
        assert_problem(writer.get("/v1/audit"), 403, "forbidden")


def test_a_refused_change_leaves_no_record(service: Service) -> None:
    with admin(service) as (client, own):
        before = client.get("/v1/audit").json()["data"]
        assert client.delete(f"/v1/keys/{own}").status_code == 409
        assert client.post("/v1/jobs/job_none/cancel").status_code == 404
        assert client.get("/v1/audit").json()["data"] == before


def test_logins_are_on_record(service: Service) -> None:
    token = service.token("read")
    page = {"Origin": service.url}
    with httpx.Client(base_url=service.url, headers=page, trust_env=False) as browser:
        assert browser.post("/dashboard/login", data={"key": "wrong"}).status_code == 401
        assert browser.post("/dashboard/login", data={"key": token}).status_code == 303
        assert browser.post("/dashboard/logout").status_code == 303
    with service.client() as client:
        actions = [entry["action"] for entry in client.get("/v1/audit").json()["data"]]
    done = [action for action in actions if not action.startswith("key.")]
    assert done == ["session.ended", "session.begun", "login.failed"]


def test_three_hundred_wrong_logins_are_refused_and_not_recorded_one_by_one(service: Service) -> None:
    with service.client() as client:
        client.get("/v1/jobs")  # a token that was right here before
        with httpx.Client(base_url=service.url, headers={"Origin": service.url}, trust_env=False) as guesser:
            answers = [guesser.post("/dashboard/login", data={"key": f"guess {turn}"}) for turn in range(300)]
        statuses = [answer.status_code for answer in answers]
        assert statuses.count(401) == attempts.PER_ADDRESS
        assert statuses.count(429) == 300 - attempts.PER_ADDRESS
        assert 0 < int(answers[-1].headers["Retry-After"]) <= attempts.WINDOW_S
        assert "Too many wrong keys" in answers[-1].text
        assert client.get("/v1/jobs").status_code == 200
        entries = client.get("/v1/audit").json()["data"]
    actions = [entry["action"] for entry in entries]
    assert actions.count("login.failed") == attempts.PER_ADDRESS
    assert actions.count("attempts.limited") == 1


def test_wrong_tokens_are_limited_as_logins_are(service: Service) -> None:
    with service.client() as client, service.client(None) as guesser:
        client.get("/v1/jobs")
        for turn in range(attempts.PER_ADDRESS):
            assert guesser.get("/v1/jobs", headers=bearer(f"guess {turn}")).status_code == 401
        refused = guesser.get("/v1/jobs", headers=bearer("one more"))
        assert_problem(refused, 429, "too_many_attempts")
        assert int(refused.headers["Retry-After"]) > 0
        assert client.get("/v1/jobs").status_code == 200
        page = {"Origin": service.url}
        entered = httpx.post(
            f"{service.url}/dashboard/login", data={"key": "x"}, headers=page, trust_env=False
        )
        assert entered.status_code == 429


def test_answers_of_the_api_are_kept_by_no_cache_and_run_by_no_browser(service: Service) -> None:
    with service.client() as client:
        for path in ("/v1/keys", "/v1/jobs", "/v1/keys/none"):
            headers = client.get(path).headers
            assert headers["Cache-Control"] == "no-store"
            assert headers["Content-Security-Policy"].startswith("default-src 'none'")
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["Referrer-Policy"] == "no-referrer"
        assert "frame-ancestors 'none'" in client.get("/docs").headers["Content-Security-Policy"]
