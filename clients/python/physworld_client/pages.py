"""Pages of a list, newest first, and the iteration over all of them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True)
class ListPage(Generic[Item]):
    """One page of a list.

    Attributes:
        data: the items of this page.
        has_more: whether older items follow.
        next_cursor: pass it as ``cursor`` for the next page.
        fetch: the same list from another cursor.
    """

    data: list[Item]
    has_more: bool
    next_cursor: str | None
    fetch: Callable[[str], ListPage[Item]]

    def auto_paging_iter(self) -> Iterator[Item]:
        """All items from this page on; further pages are fetched as they are reached."""
        page = self
        while True:
            yield from page.data
            if not page.has_more or page.next_cursor is None:
                return
            page = page.fetch(page.next_cursor)


@dataclass(frozen=True)
class AsyncListPage(Generic[Item]):
    """One page of a list; the asynchronous twin of ``ListPage``."""

    data: list[Item]
    has_more: bool
    next_cursor: str | None
    fetch: Callable[[str], Awaitable[AsyncListPage[Item]]]

    async def auto_paging_iter(self) -> AsyncIterator[Item]:
        """All items from this page on; further pages are fetched as they are reached."""
        page = self
        while True:
            for item in page.data:
                yield item
            if not page.has_more or page.next_cursor is None:
                return
            page = await page.fetch(page.next_cursor)
