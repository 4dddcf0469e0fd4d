"""Where a client finds its service when it is told nothing: the environment, or the embedded service of this machine.

The embedded service writes ``DATA/run/state.json`` with its address and the place of its API key.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from physworld_client.errors import PhysWorldError

USUAL_FOLDER = "~/.local/share/physworld"


@dataclass(frozen=True)
class Place:
    """An address, its key, and the name under which its signing keys are pinned; None: that of the address."""

    url: str
    token: str | None
    known_as: str | None = None


def where(url: str | None, token: str | None) -> Place:
    """The service that was named, else that of the environment, else the one that runs on the data folder.

    Raises:
        PhysWorldError: no address is known.
    """
    token = token or os.environ.get("PHYSWORLD_TOKEN")
    known = url if url is not None else os.environ.get("PHYSWORLD_URL") or None
    if known is not None:
        return Place(known, token)
    folder = Path(os.environ.get("PHYSWORLD_DATA_DIR") or USUAL_FOLDER).expanduser().absolute()
    try:
        state = json.loads((folder / "run" / "state.json").read_bytes())
        address, key_file = str(state["api_url"]), Path(state["api_key_file"])
        return Place(address, token or key_file.read_text().strip(), str(folder))
    except (OSError, ValueError, KeyError) as error:
        raise PhysWorldError(
            f"no service is known: give base_url, set PHYSWORLD_URL, or start one on {folder} with `physworld up`"
        ) from error
