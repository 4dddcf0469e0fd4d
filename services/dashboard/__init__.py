"""What people look at: server-rendered pages over the storage, live through server-sent events.

Reads the database and the artifact store; the one thing that it changes is a job that somebody cancels or retries.
"""

from __future__ import annotations

from physworld_services.dashboard.app import mount

__all__ = ["mount"]
