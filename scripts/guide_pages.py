"""Hooks of the guide's build (``mkdocs.yml``): what MkDocs does not read by itself.

- ``CONTRIBUTING.md``, ``CHANGELOG.md`` and ``SECURITY.md`` of the repository's root become pages below ``project/``.
- A notebook ``notebooks/NAME.ipynb`` becomes the page ``notebooks/NAME.md``, with the outputs that it was saved with;
  the notebook itself lies beside it.
- Links that lead from ``docs/`` to those files lead to their pages.
- A picture that leads to a film becomes the film, which plays when it is asked to.
- GitHub starts a list right below a paragraph; Python-Markdown wants an empty line between the two.
"""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PROJECT = {
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changes.md",
    "SECURITY.md": "project/security_policy.md",
}
ROOT_README = "../README.md"
LINK = re.compile(r"(\[[^\]]*\]\()([^)\s#]+)(#[^)\s]*)?\)")
FILM = re.compile(r"\[!\[([^\]]*)\]\(([^)\s]+)\)\]\(([^)\s]+\.mp4)\)")
CODE = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
FENCE = re.compile(r"^\s*(```|~~~)")
ITEM = re.compile(r"^(?:[-*+]|\d+\.) +\S")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made of files outside ``docs/`` and of notebooks."""
    from mkdocs.structure.files import File

    for name, page in PROJECT.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        saved = json.loads(Path(notebook.abs_src_path or "").read_text())
        page = notebook.src_uri.removesuffix(".ipynb") + ".md"
        files.append(File.generated(config, page, content=notebook_page(saved, Path(notebook.src_uri).name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Mend films, links and lists of a page before it is rendered."""
    return with_lists(with_links(with_films(markdown), page.file.src_uri))


def with_films(markdown: str) -> str:
    """The text with a player in the place of every picture that leads to a film."""
    return FILM.sub(
        r'<video controls loop muted playsinline preload="none" width="640" height="480" aria-label="\1" '
        r'poster="\2" src="\3"></video>',
        markdown,
    )


def with_links(markdown: str, page: str) -> str:
    """The text with links to other files of the repository turned to their pages; ``page`` is where it stands."""
    origin = next((name for name, made in PROJECT.items() if made == page), None)
    folder = posixpath.dirname(page)

    def mended(found: re.Match[str]) -> str:
        before, target, anchor = found[1], found[2], found[3] or ""
        if re.match(r"[a-z]+:", target):
            return found[0]
        # where the link leads, seen from docs/
        seen = posixpath.normpath(posixpath.join("..", target) if origin else posixpath.join(folder, target))
        inside = {f"../{name}": made for name, made in PROJECT.items()} | {ROOT_README: "index.md"}
        goal = inside.get(seen, seen.removeprefix("../docs/"))
        if goal.endswith(".ipynb") and not before.startswith("[Download"):
            goal = goal.removesuffix(".ipynb") + ".md"
        if goal.startswith("../"):  # a file that the guide does not hold: its name remains
            return before[1:-2]
        return f"{before}{posixpath.relpath(goal, folder or '.')}{anchor})"

    parts = CODE.split(markdown)  # text and code take turns
    return "".join(part if number % 2 else LINK.sub(mended, part) for number, part in enumerate(parts))


def with_lists(markdown: str) -> str:
    """The text with an empty line before every list that follows a paragraph."""
    lines: list[str] = []
    in_code = False
    for line in markdown.split("\n"):
        in_code ^= FENCE.match(line) is not None
        before = lines[-1] if lines else ""
        in_list = before.startswith((" ", "|")) or ITEM.match(before) is not None
        if not in_code and ITEM.match(line) and before and not in_list:
            lines.append("")
        lines.append(line)
    return "\n".join(lines)


def notebook_page(notebook: dict[str, Any], name: str) -> str:
    """Markdown of a notebook: its texts, its code, and of its outputs the text and the pictures."""
    parts: list[str] = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif source.strip():
            parts.append(f"```python\n{source}\n```")
            parts += [text for output in cell["outputs"] if (text := _output(output))]
    parts.append(f"[Download {name}]({name})")
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f"![output of the cell above](data:image/png;base64,{''.join(data['image/png']).strip()})"
    text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
    return f"```text\n{text}\n```" if text else ""
