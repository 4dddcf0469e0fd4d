"""Links in ``build/packages`` that show the type checker every package under the name by which it is imported.

An editable install maps names to folders by code (``setup.py``), which a type checker does not run.
"""

from importlib.util import find_spec
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "build" / "packages"
NAMES = ("", "_client", "_scenes", "_schemas", "_services", "_storage", "_workers")


def main() -> None:
    """Make the links anew."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in (f"physworld{ending}" for ending in NAMES):
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            raise SystemExit(f"{name} is not installed: run scripts/bootstrap.sh")
        link = FOLDER / name
        link.unlink(missing_ok=True)
        link.symlink_to(Path(spec.origin).parent)


if __name__ == "__main__":
    main()
