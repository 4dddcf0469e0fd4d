"""API keys of a service, for those whose own key may manage them."""

from __future__ import annotations

from physworld_client.async_base import AsyncListed
from physworld_client.pages import AsyncListPage
from physworld_client.types import ApiKey
from physworld_schemas.key import DEFAULT_LIFETIME_DAYS, KeyCreate, KeyRotate, Role


class AsyncKeys(AsyncListed):
    """API keys: made, listed, given another token, revoked."""

    resource = "keys"

    async def create(
        self, name: str, role: Role = "read", *, expires_in_days: int | None = DEFAULT_LIFETIME_DAYS
    ) -> ApiKey:
        """Makes a key; its ``token`` is in this answer and in no other.

        Args:
            name: who or what uses the key.
            role: "read", "write", or "admin", which may manage keys too.
            expires_in_days: its term; None: it never ends.
        """
        body = KeyCreate(name=name, role=role, expires_in_days=expires_in_days)
        return await self._send("POST", ApiKey, "keys", body=body)

    async def list(self, *, limit: int | None = None, cursor: str | None = None) -> AsyncListPage[ApiKey]:
        """Keys, newest first, the revoked and expired ones too."""
        return await self._page(ApiKey, "keys", cursor=cursor, limit=limit)

    async def rotate(self, key_id: str, *, grace_minutes: int | None = None) -> ApiKey:
        """Gives a key another token and its whole term again; the old token stays good for the grace."""
        body = KeyRotate() if grace_minutes is None else KeyRotate(grace_minutes=grace_minutes)
        return await self._send("POST", ApiKey, "keys", await self.id_of(key_id), "rotate", body=body)

    async def revoke(self, key_id: str) -> ApiKey:
        """Ends a key, and what it opened, at once."""
        return await self._send("DELETE", ApiKey, "keys", await self.id_of(key_id))
