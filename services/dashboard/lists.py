"""What every list of the pages has: a place in it, words to search for, and a state to keep to, all in the address."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Depends, Query

from physworld_schemas.base import holds_unstorable_characters

LONGEST = 200


@dataclass(frozen=True)
class Looked:
    """What is asked of a list.

    Attributes:
        cursor: where the page begins; None: with the newest.
        q: words that each item has to hold.
        state: the only state to show, where the list has one.
        model: the only model, where the list has one.
    """

    cursor: str | None = None
    q: str = ""
    state: str | None = None
    model: str | None = None

    @property
    def kept(self) -> str:
        """What further pages of the list keep of the address."""
        named = {"q": self.q, "state": self.state, "model": self.model}
        return urlencode({name: value for name, value in named.items() if value})

    @property
    def address(self) -> str:
        """The same with the place."""
        return "&".join(
            part for part in (self.kept, urlencode({"cursor": self.cursor}) if self.cursor else "") if part
        )

    @property
    def narrowed(self) -> bool:
        """Whether not everything is asked for."""
        return bool(self.kept)

    def context(self, next_cursor: str | None) -> dict[str, Any]:
        """What the templates of lists are given."""
        return {"looked": self, "cursor": self.cursor, "next_cursor": next_cursor}


def looked(
    cursor: Annotated[str | None, Query(max_length=512)] = None,
    q: Annotated[str, Query(max_length=LONGEST)] = "",
    state: Annotated[str | None, Query(pattern=r"^[a-z]{0,20}$")] = None,
    model: Annotated[str | None, Query(max_length=64)] = None,
) -> Looked:
    """Dependency of every list. A search for what no text here can hold finds what an empty one does."""
    return Looked(cursor, "" if holds_unstorable_characters(q) else q.strip(), state or None, model or None)


Asked = Annotated[Looked, Depends(looked)]
