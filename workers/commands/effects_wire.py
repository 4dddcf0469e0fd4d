"""``python -m physworld_workers.commands.effects_wire``: write the registry of effects in the form that the API serves.

The web process holds neither warp nor the registry, so it reads ``services/api/effects.json``; a test compares the two.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

FILE = Path(__file__).parents[2] / "services" / "api" / "effects.json"


def wire_effects() -> list[dict[str, Any]]:
    """Every effect as ``physworld_schemas.library.Effect``: name, title, kind, law, unit of each strength."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # before the first import that starts it
    from physworld.twin.build import build_twin
    from physworld_workers.commands.effects import effects_document, everyday_scenes

    document = effects_document({name: build_twin(scene, 300) for name, scene in everyday_scenes().items()})
    return [
        {
            "name": entry["name"],
            "title": entry["title"],
            "kind": entry["kind"],
            "law": entry["equation"],
            "parameters": {
                strength["name"]: strength["unit"]
                for body in entry["bodies"].values()
                for strength in body["strengths"]
            },
        }
        for entry in document["effects"]
    ]


def main() -> int:
    """Write the file."""
    FILE.write_text(json.dumps(wire_effects(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
