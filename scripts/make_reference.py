"""``python -m scripts.make_reference``: write the two pages of ``docs/reference/`` that the code itself tells.

``commands.md`` is made of the command line's own parser, ``catalogue.md`` of ``schemas/catalogue.json``. A test asks
that both are what this writes.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from physworld_client.cli.app import app
from typer.main import get_command

ROOT = Path(__file__).resolve().parents[1]
CATALOGUE = ROOT / "schemas" / "catalogue.json"
FOLDER = ROOT / "docs" / "reference"
COMMANDS_HEAD = """# Command line

Every command with its arguments and options, written by `make reference` from the program's own parser. `--help`
after any command prints the same. Exit codes: 0 done; 1 the work failed or the service refused; 2 the command line is
wrong; 3 `up` where the service already runs; 130 interrupted.
"""
CATALOGUE_HEAD = """# Catalogue

Constitutive laws, effects, metrics, importers and export formats, written by `make reference` from
`schemas/catalogue.json`, which holds what each declares where it is implemented.
[Materials](../materials.md), [effects](../effects.md) and [the method](../method.md#metrics) explain them.
"""


def commands_page() -> str:
    """The page of all commands, in the order in which ``physworld --help`` lists them."""
    parts = [COMMANDS_HEAD]
    root = get_command(app)
    for words, command in _commands(root, ["physworld"]):
        parts.append(f"## {' '.join(words)}\n\n{_paragraphs(command.help or '')}\n")
        context = command.make_context(words[-1], ["--help"], resilient_parsing=True)
        pieces = [
            re.sub(r"\{(\w+)\}", lambda name: name[1].upper(), part)
            for part in command.collect_usage_pieces(context)
        ]
        usage = " ".join([*words, *pieces])
        parts.append(f"```text\n{usage}\n```\n")
        rows = [row for parameter in command.params if (row := _parameter(parameter)) is not None]
        if rows:
            parts.append("| argument or option | default | |\n|---|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def catalogue_page() -> str:
    """The page of the catalogue."""
    found = json.loads(CATALOGUE.read_text())
    parts = [CATALOGUE_HEAD, "## Constitutive laws\n"]
    for law in found["materials"]:
        parts.append(f"### `{law['name']}`: {law['title']}\n")
        parts.append(f"Body: {law['body']}. Kind: {law['kind']}. For {law['use']}.\n")
        parts.append(f"```text\n{law['equation']}\n```\n")
        parts.append(_quantities(law["parameters"]))
    parts.append("## Effects\n")
    for effect in found["effects"]:
        parts.append(f"### `{effect['name']}`: {effect['title']}\n\nWhere it enters: {effect['kind']}.\n")
        parts.append(f"```text\n{effect['equation']}\n```\n")
        parts.append(_quantities(effect["parameters"]))
    parts.append("## Metrics\n\n| name | unit | definition |\n|---|---|---|")
    parts += [f"| `{one['name']}` | {one['unit']} | {_cell(one['help'])} |" for one in found["metrics"]]
    parts.append("\n## Importers\n\n| name | suffixes | what is read |\n|---|---|---|")
    parts += [
        f"| `{one['name']}` | {', '.join(one['suffixes'])} | {one['title']}: {_cell(one['help'])} |"
        for one in found["importers"]
    ]
    parts.append("\n## Export formats\n\n| name | what is written |\n|---|---|")
    parts += [f"| `{one['name']}` | {one['title']}: {_cell(one['help'])} |" for one in found["exports"]]
    return "\n".join(parts) + "\n"


def pages() -> dict[Path, str]:
    """Every written page with its text."""
    return {FOLDER / "commands.md": commands_page(), FOLDER / "catalogue.md": catalogue_page()}


def _commands(command: Any, words: list[str]) -> list[tuple[list[str], Any]]:
    """Every command below this one with its words. Typer brings its own Click: no class is asked for."""
    if not hasattr(command, "commands"):
        return [(words, command)]
    inner = [(name, part) for name, part in command.commands.items() if not part.hidden]
    return [found for name, part in inner for found in _commands(part, [*words, name])]


def _parameter(parameter: Any) -> str | None:
    """A row of the table; None for what every program has."""
    if parameter.name == "help" or getattr(parameter, "hidden", False):
        return None
    if parameter.param_type_name == "option":
        name = ", ".join([*parameter.opts, *parameter.secondary_opts])
    else:
        name = (parameter.name or "").upper()
    default: Any = parameter.default
    shown = "" if default in (None, "", [], ()) or callable(default) or default is False else str(default)
    shown = "required" if parameter.required else (f"`{shown}`" if shown else "")
    return f"| `{name}` | {shown} | {_cell(getattr(parameter, 'help', None) or '')} |"


def _quantities(parameters: dict[str, dict[str, Any]]) -> str:
    if not parameters:
        return "It has no numbers of its own.\n"
    rows = ["| number | unit | default | bounds | |", "|---|---|---|---|---|"]
    for name, quantity in parameters.items():
        default = "" if quantity["default"] is None else f"{quantity['default']:.4g}"
        bounds = "; ".join(f"{body} {_bounds(pair)}" for body, pair in quantity["bounds"].items())
        rows.append(f"| `{name}` | {quantity['unit']} | {default} | {bounds} | {_cell(quantity['help'])} |")
    return "\n".join(rows) + "\n"


def _bounds(pair: list[float | None]) -> str:
    low, high = ("…" if end is None else f"{end:.4g}" for end in pair)
    return f"{low} to {high}"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for path, text in pages().items():
        path.write_text(text)
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
