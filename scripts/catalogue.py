"""``python -m scripts.catalogue``: write ``schemas/catalogue.json`` and the tables of it in the docs.

A table stands between two comments of a page, ``<!-- catalogue NAME -->`` and ``<!-- end of NAME -->``. A test asks
that file and pages are what this writes.
"""

from __future__ import annotations

import re
from pathlib import Path

from physworld_client.export import FORMATS

from physworld_schemas.library import FILE, Catalogue, Effect, ExportFormat, Material, Quantity
from physworld_workers.commands.catalogue import as_json, registered

ROOT = Path(__file__).resolve().parents[1]
CATALOGUE = ROOT / "schemas" / FILE
TABLE = re.compile(r"(<!-- catalogue (?P<name>\w+) -->\n).*?(<!-- end of (?P=name) -->)", re.DOTALL)


def own_catalogue() -> Catalogue:
    """Everything that this repository declares."""
    exports = [ExportFormat(name=name, title=form.title, help=form.help) for name, form in FORMATS.items()]
    return registered().model_copy(update={"exports": exports})


def tables(found: Catalogue) -> dict[str, str]:
    """Markdown of every table by name."""
    elastic = [law for law in found.materials if law.kind == "elastic"]
    return {
        **{
            shape: _laws([law for law in elastic if law.body == shape]) for shape in ("solid", "sheet", "rod")
        },
        "flow": _laws([law for law in found.materials if law.kind == "flow"]),
        "effects": _table(
            ("effect", "where it enters", "strengths of a solid, a sheet and a rod of everyday size"),
            [(f"`{effect.name}`", effect.kind, _strengths(effect)) for effect in found.effects],
        ),
        "metrics": _table(
            ("name", "unit", "definition"),
            [(f"`{metric.name}`", metric.unit, metric.help) for metric in found.metrics],
        ),
        "importers": _table(
            ("name", "form", "suffixes", "what is read"),
            [(f"`{one.name}`", one.title, ", ".join(one.suffixes), one.help) for one in found.importers],
        ),
        "exports": _table(
            ("format", "", "what is written"),
            [(f"`{form.name}`", form.title, form.help) for form in found.exports],
        ),
    }


def written(page: str, by_name: dict[str, str]) -> str:
    """A page with its tables."""
    return TABLE.sub(lambda found: f"{found[1]}{by_name[found['name']]}{found[3]}", page)


def _laws(laws: list[Material]) -> str:
    """One row a law; constants that a row above explains are not explained again."""
    rows, explained = [], set[str]()
    for law in laws:
        constants = [
            _constant(name, quantity) for name, quantity in law.parameters.items() if name not in explained
        ]
        same = [f"those of `{laws[0].name}`"] if explained & law.parameters.keys() else []
        explained |= law.parameters.keys()
        rows.append((f"`{law.name}`", f"`{law.equation}`", law.use, "; ".join([*same, *constants]) or "none"))
    return _table(("name", "equation", "for", "constants"), rows)


def _constant(name: str, quantity: Quantity) -> str:
    default = "" if quantity.default is None else f", {quantity.default:.4g} by default"
    return f"`{name}`{_unit(quantity)}: {quantity.help}{default}"


def _strengths(effect: Effect) -> str:
    lines = []
    for name, quantity in effect.parameters.items():
        spans = {shape: f"{low:.3g} to {high:.3g}" for shape, (low, high) in quantity.bounds.items()}
        same = len(set(spans.values())) == 1
        bounds = next(iter(spans.values())) if same else ", ".join(map(" ".join, spans.items()))
        text = f"`{name}`{_unit(quantity)} {bounds}"
        lines.append(text if quantity.gate else f"({text})")
    refused = [f"not for a {shape}: {reason}" for shape, reason in effect.refused.items()]
    return "; ".join([*lines, *refused])


def _unit(quantity: Quantity) -> str:
    return "" if quantity.unit == "1" else f" [{quantity.unit}]"


def _table(headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [headings, tuple("---" for _ in headings), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def main() -> None:
    """Write the file, then the pages."""
    found = own_catalogue()
    CATALOGUE.write_text(as_json(found), encoding="utf-8")
    for path in sorted(ROOT.glob("docs/*.md")):
        page = path.read_text(encoding="utf-8")
        if (new := written(page, tables(found))) != page:
            path.write_text(new, encoding="utf-8")
            print(path.relative_to(ROOT))
    print(CATALOGUE.relative_to(ROOT))


if __name__ == "__main__":
    main()
