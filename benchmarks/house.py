"""``python -m benchmarks.house [--tree FOLDER] [--json FILE] [--page FILE]``: how the house is built, in numbers.

Counts files and lines of every room, short files, long functions, public functions without an Args section, modules
that no strict type checker reads, copies of the network's step, and the files that each kind of addition touches.
``--tree`` names another checkout of the repository; ``--page`` writes the counts beside those of
``benchmarks/records/house_before.json`` between the markers of a page. Nothing is imported from the tree that is
counted, so that any commit can be: a room is a folder, and files are those that git tracks.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.house_lists import ADDITIONS, STEPS

ROOT = Path(__file__).resolve().parents[1]
BEFORE = Path(__file__).parent / "records" / "house_before.json"
PRODUCT = ("physworld", "scenes", "schemas", "storage", "workers", "services", "clients")
BESIDE = ("benchmarks", "scripts", "tests")
INNER = ("physworld", "storage", "services")
"""Folders whose subfolders are rooms of their own."""
SHORT_FILE, LONG_FUNCTION, MANY_PARAMETERS = 60, 80, 4
CALLED_BY_FRAMEWORKS = ("wp", "router", "app", "pages", "command")
"""Names in the decorators of kernels, routes and commands: no Python caller reads an Args section of theirs."""
REFERENCE = re.compile(r"(?s)arguments\b.{0,90}:(?:meth|class|func):|:(?:meth|class|func):.{0,90}\barguments")
"""Text that names the function, method or class whose arguments these are."""
GENERATED = "# Made of async_"
"""How a file begins that a script made of another one: its docstrings are those of the file that it was made of."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def tracked(tree: Path) -> list[Path]:
    """The Python files of a checkout, relative to it."""
    listed = subprocess.run(
        ["git", "-C", str(tree), "ls-files", "*.py"], capture_output=True, text=True, check=True
    )
    return [Path(line) for line in listed.stdout.splitlines() if (tree / line).is_file()]


def room_of(path: Path) -> str:
    """The room of a file: its top-level folder, of large ones with the folder below."""
    parts = path.parts
    if parts[0] in INNER and len(parts) > 2 and parts[1] != "migrations":
        return "/".join(parts[:2])
    return parts[0]


def functions(module: ast.Module) -> Iterator[tuple[Function, ast.ClassDef | None]]:
    """Every function and method of a module that is not nested in another function, with its class."""
    for node in module.body:
        if isinstance(node, Function):
            yield node, None
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, Function):
                    yield inner, node


def all_functions(module: ast.Module) -> Iterator[Function]:
    """Every function, nested ones among them."""
    return (node for node in ast.walk(module) if isinstance(node, Function))


@dataclass(frozen=True)
class Told:
    """What is told of parameters elsewhere than in a function's docstring.

    Attributes:
        inherited: classes and methods whose Args section stands in a base class.
        annotations: names of types that carry their own help, as ``Json = Annotated[bool, typer.Option(help=...)]``.
    """

    inherited: frozenset[tuple[str, str]] = frozenset()
    annotations: frozenset[str] = frozenset({"Annotated"})


def wants_args(function: Function, owner: ast.ClassDef | None, told: Told) -> bool:
    """Whether it is public, is called by people, has four parameters or more, and no Args section tells of them.

    Not counted is what an Args section would only repeat, and drift from: a constructor whose class has the section; a
    method that overrides one with it, since it is called through the base; a function that says whose arguments its own
    are (``REFERENCE``); a command or dependency whose parameters are ``Annotated`` with their help; a kernel or route.

    Args:
        function: the function or method.
        owner: its class; None of a function.
        told: what base classes and types of the same checkout tell.
    """
    name = function.name
    public = name == "__init__" or not name.startswith("_")
    if not public or (owner is not None and owner.name.startswith("_")):
        return False
    if any(_names(decorator) & set(CALLED_BY_FRAMEWORKS) for decorator in function.decorator_list):
        return False
    if owner is not None and (owner.name, name) in told.inherited:
        return False
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    if any(_type_name(one.annotation) in told.annotations for one in given):
        return False
    count = len(given)
    is_static = any("staticmethod" in _names(decorator) for decorator in function.decorator_list)
    count -= owner is not None and not is_static
    texts = [ast.get_docstring(function) or ""]
    if name == "__init__" and owner is not None:
        texts.append(ast.get_docstring(owner) or "")
    told_here = any("Args:" in text or REFERENCE.search(text) for text in texts)
    return count >= MANY_PARAMETERS and not told_here


def _names(decorator: ast.expr) -> set[str]:
    """The dotted names of a decorator without its arguments: ``wp`` and ``kernel`` of ``@wp.kernel(...)``."""
    target = decorator.func if isinstance(decorator, ast.Call) else decorator
    names = {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}
    return names | {node.attr for node in ast.walk(target) if isinstance(node, ast.Attribute)}


def _type_name(node: ast.expr | None) -> str:
    """The name of a type without what stands in its brackets."""
    node = node.value if isinstance(node, ast.Subscript) else node
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def told_elsewhere(modules: Iterable[ast.Module]) -> Told:
    """What base classes, found by their names, and annotated types tell of the functions of these modules."""
    bases: dict[str, set[str]] = {}
    sections: set[tuple[str, str]] = set()
    annotations = {"Annotated"}
    for module in modules:
        for node in ast.walk(module):
            if isinstance(node, ast.Assign) and _type_name(node.value) == "Annotated":
                annotations |= {target.id for target in node.targets if isinstance(target, ast.Name)}
            if not isinstance(node, ast.ClassDef):
                continue
            bases.setdefault(node.name, set()).update(_type_name(base) for base in node.bases)
            sections |= {
                (node.name, inner.name)
                for inner in node.body
                if isinstance(inner, Function) and "Args:" in (ast.get_docstring(inner) or "")
            }
    inherited = set()
    for name in bases:
        above: set[str] = set()
        waiting = set(bases[name])
        while waiting:
            above |= waiting
            waiting = {base for known in waiting for base in bases.get(known, ())} - above
        inherited |= {(name, method) for base, method in sections if base in above - {name}}
    return Told(frozenset(inherited), frozenset(annotations))


def unchecked(tree: Path, product: list[Path]) -> tuple[int, int]:
    """How many modules no type checker reads, and how many it does not read strictly."""
    settings = tomllib.loads((tree / "pyproject.toml").read_text())["tool"].get("mypy", {})
    folders = {
        "clients" if name == "physworld_client" else name.removeprefix("physworld_")
        for name in settings.get("packages", [])
    }
    read = sum(path.parts[0] in folders for path in product)
    return len(product) - read, len(product) - (read if settings.get("strict") else 0)


def counts(tree: Path) -> dict[str, Any]:
    """Everything that is counted of a checkout."""
    files = tracked(tree)
    product = [path for path in files if path.parts[0] in PRODUCT]
    rooms: dict[str, Counter[str]] = {}
    lengths: dict[Path, int] = {}
    found: Counter[str] = Counter()
    modules = {path: ast.parse((tree / path).read_text()) for path in product}
    told = told_elsewhere(modules.values())
    for path in files:
        if path.parts[0] not in PRODUCT + BESIDE:
            continue
        text = (tree / path).read_text()
        lengths[path] = len(text.splitlines())
        room = rooms.setdefault(room_of(path), Counter())
        room.update(files=1, lines=lengths[path])
        if path.parts[0] not in PRODUCT:
            continue
        module = modules[path]
        short = lengths[path] < SHORT_FILE and path.name != "__init__.py"
        long = sum((f.end_lineno or f.lineno) - f.lineno + 1 > LONG_FUNCTION for f in all_functions(module))
        bare = 0
        if not text.startswith(GENERATED):
            bare = sum(wants_args(function, owner, told) for function, owner in functions(module))
        for counter in (room, found):
            counter.update(short=short, long=long, bare=bare)
    unread, loose = unchecked(tree, product)
    whole = sorted(lengths[path] for path in product if path.name != "__init__.py")
    return {
        "commit": subprocess.run(
            ["git", "-C", str(tree), "rev-parse", "--short=7", "HEAD"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip(),
        "product_files": len(product),
        "product_lines": sum(lengths[path] for path in product),
        "median_lines": whole[len(whole) // 2],
        "largest_flat_folder": max(Counter(path.parent for path in product).values()),
        "short_files": found["short"],
        "long_functions": found["long"],
        "functions_without_args": found["bare"],
        "modules_without_types": unread,
        "modules_without_strict_types": loose,
        "steps": sorted(name for name, places in STEPS.items() if any(_defines(tree, *at) for at in places)),
        "additions": {kind: _touched(tree, layouts) for kind, layouts in ADDITIONS.items()},
        "rooms": {name: dict(rooms[name]) for name in sorted(rooms)},
    }


def _defines(tree: Path, path: str, text: str) -> bool:
    return (tree / path).is_file() and text in (tree / path).read_text()


def _touched(tree: Path, layouts: tuple[tuple[str, ...], ...]) -> list[str]:
    """The files of the layout that the tree has: before the rooms were rebuilt, there were no scenes apart."""
    wanted = layouts[0 if (tree / "scenes").is_dir() else -1]
    missing = [path for path in wanted if not (Path(path).stem.isupper() or (tree / path).is_file())]
    missing += [path for path in wanted if Path(path).stem.isupper() and not (tree / path).parent.is_dir()]
    if missing:
        raise SystemExit(f"benchmarks/house_lists.py names what {tree} does not have: {', '.join(missing)}")
    return list(wanted)


SINGLE = {
    "product_files": "files of the product",
    "product_lines": "lines of the product",
    "median_lines": "lines of its median file",
    "largest_flat_folder": "files of its largest flat folder",
    "short_files": f"files under {SHORT_FILE} lines",
    "long_functions": f"functions over {LONG_FUNCTION} lines",
    "functions_without_args": f"public functions with {MANY_PARAMETERS} parameters or more and no Args section",
    "modules_without_types": "modules that no type checker reads",
    "modules_without_strict_types": "modules that no strict type checker reads",
}


def markdown(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Two tables: what is counted once, and the rooms."""
    lines = [f"| | before ({before['commit']}) | now |", "|---|---|---|"]
    lines += [f"| {text} | {before[key]} | {now[key]} |" for key, text in SINGLE.items()]
    lines.append(f"| distinct copies of the network's step | {len(before['steps'])} | {len(now['steps'])} |")
    lines += [
        f"| files to touch for {kind} | {len(before['additions'][kind])} | {len(now['additions'][kind])} |"
        for kind in now["additions"]
    ]
    lines += ["", "| room | files before | lines before | files | lines | short | long | no Args |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for name in sorted({*before["rooms"], *now["rooms"]}):
        old, new = before["rooms"].get(name, {}), now["rooms"].get(name, {})
        cells = [old.get("files", ""), old.get("lines", ""), new.get("files", ""), new.get("lines", "")]
        cells += [new.get(key, "") for key in ("short", "long", "bare")]
        lines.append(f"| {name} | " + " | ".join(map(str, cells)) + " |")
    lines += [
        "",
        "The steps: " + "; ".join(now["steps"]) + ". The files of an addition, beside its tests and docs:",
        "",
    ]
    lines += [
        f"- {kind}: " + ", ".join(f"`{path}`" for path in paths) for kind, paths in now["additions"].items()
    ]
    return "\n".join(lines) + "\n"


def write_page(page: Path, text: str) -> None:
    """Replaces what lies between the markers of a page."""
    begin, end = "<!-- house: begin -->\n", "<!-- house: end -->"
    head, rest = page.read_text().split(begin, 1)
    page.write_text(head + begin + text + end + rest.split(end, 1)[1])


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--tree", type=Path, default=ROOT, help="the checkout to count")
    parser.add_argument("--json", type=Path, help="write the counts to this file")
    parser.add_argument("--page", type=Path, help="write the tables between this page's markers")
    given = parser.parse_args()
    now = counts(given.tree)
    if given.json:
        given.json.write_text(json.dumps(now, indent=1) + "\n")
    before = json.loads(BEFORE.read_text()) if BEFORE.is_file() else now
    text = markdown(before, now)
    if given.page:
        write_page(given.page, text)
    print(json.dumps(now, indent=1))
    print(text)


if __name__ == "__main__":
    main()
