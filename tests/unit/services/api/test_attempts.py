"""Limits on wrong keys: who waits, who does not, and what a flood costs."""

from __future__ import annotations

import pytest

from physworld_services.api import attempts
from physworld_services.api.attempts import (
    MOST_ADDRESSES,
    MOST_KEYS,
    OVERALL,
    PER_ADDRESS,
    WINDOW_S,
    Attempts,
)


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def limits(clock: Clock) -> Attempts:
    return Attempts(clock)


def fail(limits: Attempts, address: str, times: int) -> None:
    for _ in range(times):
        limits.wrong(address)


def test_an_address_waits_for_its_own_failures_until_the_window_is_over(
    limits: Attempts, clock: Clock
) -> None:
    fail(limits, "10.0.0.1", PER_ADDRESS - 1)
    assert limits.wait_s("10.0.0.1", "t") == 0
    clock.now += 10.0
    fail(limits, "10.0.0.1", 1)
    assert limits.wait_s("10.0.0.1", "t") == WINDOW_S - 10
    assert limits.wait_s("10.0.0.2", "t") == 0
    clock.now += WINDOW_S - 10
    assert limits.wait_s("10.0.0.1", "t") == 0
    assert limits.wrong("10.0.0.1") == 1


def test_a_key_that_was_right_here_never_waits(limits: Attempts) -> None:
    limits.right("robot's")
    fail(limits, "10.0.0.1", 10 * PER_ADDRESS)
    assert limits.wait_s("10.0.0.1", "robot's") == 0
    assert limits.wait_s("10.0.0.1", "unknown") > 0


def test_a_flood_from_everywhere_leaves_one_try_to_each_address_and_locks_out_none(
    limits: Attempts, clock: Clock
) -> None:
    for turn in range(OVERALL):
        limits.wrong(f"10.0.{turn // 250}.{turn % 250}")
    assert limits.wait_s("10.0.0.1", "t") > 0
    assert limits.wait_s("192.0.2.1", "t") == 0
    clock.now += WINDOW_S
    assert limits.wait_s("10.0.0.1", "t") == 0


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("2001:db8::1", "2001:db8::ffff:2", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("::ffff:10.0.0.1", "10.0.0.1", True),
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("testclient", "testclient", True),
        ("10.0.0.1", "10.0.0.2", False),
    ],
)
def test_a_network_that_one_customer_has_counts_as_one(
    limits: Attempts, one: str, other: str, same: bool
) -> None:
    fail(limits, one, PER_ADDRESS)
    assert (limits.wait_s(other, "t") > 0) == same


def test_what_is_remembered_is_bounded(limits: Attempts) -> None:
    for turn in range(MOST_ADDRESSES + 100):
        limits.wrong(f"{turn}")
    for turn in range(MOST_KEYS + 100):
        limits.right(f"{turn}")
    assert len(limits._wrong) == MOST_ADDRESSES and len(limits._right) == MOST_KEYS
    assert all(len(digest) == 64 for digest in limits._right)  # the tokens themselves are not kept


def test_strangers_cannot_fill_the_audit_log(limits: Attempts, clock: Clock) -> None:
    assert sum(limits.may_record() for _ in range(1000)) == attempts.RECORDED
    clock.now += WINDOW_S
    assert limits.may_record()
