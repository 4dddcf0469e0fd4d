"""Limits on wrong keys: who tried too many waits, and nobody waits for what others tried.

An address has ``PER_ADDRESS`` wrong keys in ``WINDOW_S``; while all addresses together have had more than ``OVERALL``,
it has one. Beyond them a key is not even looked up until the window is over, unless it was right here before: a robot
with a wrong key behind the same router locks out nobody who is at work. A key that is new to this process does wait
there, a minute at most; an address without wrong keys never waits.

Counted per process and in memory: with N web processes the limits are N times as wide, and a restart forgets. Memory
is bounded; a stranger with more than ``MOST_ADDRESSES`` addresses can have the oldest forgotten early. An IPv6 address
counts as its network of 64 bits, which is what one customer has.
"""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from physworld_storage.access.api_keys import digest_of

WINDOW_S = 60.0
PER_ADDRESS, OVERALL = 10, 600
MOST_ADDRESSES, MOST_KEYS = 10_000, 1_000
RECORDED = 30  # wrong logins a window that the audit log is told of


class Attempts:
    """The wrong keys of the last minute, and the right ones of this process. Safe between threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._wrong: OrderedDict[str, tuple[float, int]] = (
            OrderedDict()
        )  # by address: window's start, how many
        self._right: OrderedDict[str, None] = OrderedDict()
        self._overall = (clock(), 0, 0)  # window's start, wrong keys, recorded

    def wait_s(self, address: str | None, token: str) -> int:
        """Seconds until this address may try this token; 0 is now."""
        with self._lock:
            now = self._clock()
            start, wrong = self._wrong.get(_network(address), (now, 0))
            _, overall, _ = self._window(now)
            allowed = PER_ADDRESS if overall < OVERALL else 1
            left = start + WINDOW_S - now
            if wrong < allowed or left <= 0 or digest_of(token) in self._right:
                return 0
            return math.ceil(left)

    def right(self, token: str) -> None:
        """Note that a token was a key's."""
        with self._lock:
            credential = digest_of(token)
            self._right[credential] = None
            self._right.move_to_end(credential)
            if len(self._right) > MOST_KEYS:
                self._right.popitem(last=False)

    def wrong(self, address: str | None) -> int:
        """Note a wrong token; how many this address had in its window."""
        with self._lock:
            now, network = self._clock(), _network(address)
            start, wrong = self._wrong.pop(network, (now, 0))
            if now >= start + WINDOW_S:
                start, wrong = now, 0
            self._wrong[network] = start, wrong + 1
            if len(self._wrong) > MOST_ADDRESSES:
                self._wrong.popitem(last=False)
            begun, overall, recorded = self._window(now)
            self._overall = begun, overall + 1, recorded
            return wrong + 1

    def may_record(self) -> bool:
        """Whether the audit log is told of one more wrong login: strangers cannot fill it."""
        with self._lock:
            begun, overall, recorded = self._window(self._clock())
            self._overall = begun, overall, recorded + 1
            return recorded < RECORDED

    def _window(self, now: float) -> tuple[float, int, int]:
        return self._overall if now < self._overall[0] + WINDOW_S else (now, 0, 0)


def _network(address: str | None) -> str:
    """What one customer has: an IPv4 address, or 64 bits of an IPv6 one."""
    try:
        found = ipaddress.ip_address((address or "").partition("%")[0])
    except ValueError:
        return address or ""
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)
