# Made of async_base.py by `make sdk`: change that file.
"""What the resources share: the requests they send, pages, and names in the place of ids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pydantic import BaseModel

from physworld_client import names
from physworld_client.calls import Call, given, page_of, route
from physworld_client.pages import ListPage

if TYPE_CHECKING:
    from physworld_client.client import Client

Answer = TypeVar("Answer")
Item = TypeVar("Item", bound=BaseModel)


class Resource:
    """A resource: the client that it sends through."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._client.base_url}>"

    def _send(
        self, method: str, answer: type[Answer], *places: str | int, body: BaseModel | None = None
    ) -> Answer:
        """The answer of ``/v1/`` and the places of the path."""
        return self._client.send(Call(method, route(*places), answer, body=body))

    def _page(
        self, item: type[Item], *places: str | int, cursor: str | None, **query: str | int | None
    ) -> ListPage[Item]:
        """A page of a list from a cursor on; what of the query is None is not asked."""
        asked = given(cursor=cursor, **query)
        page = self._client.send(Call("GET", route(*places), page_of(item), query=asked))
        return ListPage(
            page.data,
            page.has_more,
            page.next_cursor,
            lambda at: self._page(item, *places, cursor=at, **query),
        )


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
