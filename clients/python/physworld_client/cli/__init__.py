"""The command line ``physworld``."""

from __future__ import annotations

from physworld_client.cli.app import main

__all__ = ["main"]
