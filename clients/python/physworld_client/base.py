# Made of async_base.py by `make sdk`: change that file.
"""What the resources share: the client they send through, pages, and names in the place of ids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pydantic import BaseModel

from physworld_client import calls, names
from physworld_client.pages import ListPage

if TYPE_CHECKING:
    from physworld_client.client import Client

Item = TypeVar("Item", bound=BaseModel)


class Resource:
    """A resource: the client that it sends through."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._client.base_url}>"

    def _page(self, call_at: calls.ListCall[Item], cursor: str | None) -> ListPage[Item]:
        page = self._client.send(call_at(cursor))
        return ListPage(page.data, page.has_more, page.next_cursor, lambda at: self._page(call_at, at))


class Listed(Resource):
    """A resource with a list of all its objects.

    Wherever one of them is asked for by its id, the beginning of the id or the object's name does as well, where only
    one object fits; that takes one request more. A model is known by its whole name alone.

    Attributes:
        resource: its name among the client's attributes.
    """

    resource: ClassVar[str]

    def list(self, *, limit: int | None = None, cursor: str | None = None) -> ListPage[Any]:
        """All objects, newest first."""
        raise NotImplementedError

    def id_of(self, given: str) -> str:
        """The id (of a model: the name) of what is called so: by the id, the beginning of one, or a name.

        Raises:
            UnknownName: nothing is called that.
            AmbiguousName: several are.
        """
        if names.is_id(self.resource, given):
            return given
        search = names.Search(self.resource, given)
        page = self.list(limit=names.PAGE)
        for item in page.auto_paging_iter():
            if not search.see(item):
                break
        return search.found()
