"""What routes ask for: the opened stores, who is calling, the page of a list."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends, Path, Query, Request

from physworld_services.api.feed import Feed
from physworld_services.api.security import address_of
from physworld_services.stores import Stores
from physworld_storage.access.api_keys import ApiKey as Principal
from physworld_storage.access.audit import Actor
from physworld_storage.database import Database
from physworld_storage.settings import Settings

DEFAULT_LIMIT = 50
MAX_LIMIT = 200
ID_PATTERN = r"^[A-Za-z0-9_-]{1,64}$"


def get_database(request: Request) -> Database:
    """The database of this process."""
    return cast(Database, request.app.state.database)


def get_stores(request: Request) -> Stores:
    """The artifact and episode stores of this process."""
    return cast(Stores, request.app.state.stores)


def get_app_settings(request: Request) -> Settings:
    """The settings that this process was started with."""
    return cast(Settings, request.app.state.settings)


def get_feed(request: Request) -> Feed:
    """The events of followed jobs, as this process reads them."""
    return cast(Feed, request.app.state.feed)


def get_principal(request: Request) -> Principal:
    """The API key behind the request, put there by the authentication middleware."""
    return cast(Principal, request.state.principal)


def get_actor(request: Request) -> Actor:
    """Who asks and from where, for the audit log."""
    return Actor(get_principal(request).id, address_of(request.scope))


@dataclass(frozen=True)
class PageQuery:
    """How many rows, and where the page before ended."""

    limit: int
    cursor: str | None


def get_page_query(
    limit: Annotated[int, Query(ge=1, le=MAX_LIMIT, description="rows in one page")] = DEFAULT_LIMIT,
    cursor: Annotated[
        str | None, Query(max_length=512, description="`next_cursor` of the page before")
    ] = None,
) -> PageQuery:
    """The page that a list route was asked for."""
    return PageQuery(limit, cursor)


DatabaseDep = Annotated[Database, Depends(get_database)]
StoresDep = Annotated[Stores, Depends(get_stores)]
SettingsDep = Annotated[Settings, Depends(get_app_settings)]
FeedDep = Annotated[Feed, Depends(get_feed)]
PrincipalDep = Annotated[Principal, Depends(get_principal)]
ActorDep = Annotated[Actor, Depends(get_actor)]
PageDep = Annotated[PageQuery, Depends(get_page_query)]

ObjectId = Annotated[str, Path(pattern=ID_PATTERN, description="prefix and ULID")]
ModelName = Annotated[str, Path(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")]
