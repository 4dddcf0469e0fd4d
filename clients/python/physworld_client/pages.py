"""Pages of a list, newest first, and the iteration over all of them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pydantic import BaseModel

from physworld_client import tables

if TYPE_CHECKING:
    import pandas

Item = TypeVar("Item", bound=BaseModel)


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        return _shown(self.data, self.has_more)

    def _repr_html_(self) -> str:
        """The page as a table, for notebooks."""
        return tables.html(self.data)

    def to_pandas(self) -> pandas.DataFrame:
        """The items of this page as rows; of all pages: ``to_pandas`` of ``physworld_client``."""
        return tables.to_pandas(self.data)


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        return _shown(self.data, self.has_more)

    def _repr_html_(self) -> str:
        """The page as a table, for notebooks."""
        return tables.html(self.data)

    def to_pandas(self) -> pandas.DataFrame:
        """The items of this page as rows; of all pages: ``to_pandas`` of ``physworld_client``."""
        return tables.to_pandas(self.data)


def _shown(data: list[Any], has_more: bool) -> str:
    """``<3 Fit, older ones follow>``."""
    kind = type(data[0]).__name__ if data else "items"
    return f"<{len(data) or 'no'} {kind}{', older ones follow' if has_more else ''}>"
