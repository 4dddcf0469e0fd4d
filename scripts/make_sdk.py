"""``python scripts/make_sdk.py [--check]``: writes the synchronous half of the SDK from the asynchronous half.

``async_NAME.py`` in ``clients/python/physworld_client`` is written by hand, ``NAME.py`` is made of it: unasync takes
``async`` and ``await`` away and renames what is named after them, ruff sorts the imports and formats. ``--check``
writes nothing, names what is not current, and ends with 1.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import unasync

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "clients" / "python" / "physworld_client"
HALVES = ("artifacts", "base", "client", "keys", "live", "loop", "predict", "resources", "videos")
HEADER = "# Made of async_{name}.py by `make sdk`: change that file.\n"
WORDS = {
    "AsyncExitStack": "ExitStack",
    "aclose": "close",
    "aiter_bytes": "iter_bytes",
    "aiter_lines": "iter_lines",
    "aread": "read",
    "enter_async_context": "enter_context",
    "received_async": "received",
    **{f"async_{name}": name for name in HALVES},
}
"""What the other half calls differently, beside the words of the language that unasync knows itself."""
CLASS = re.compile(r"\bAsync(?!Iterator\b)([A-Z]\w*)")
WORD_IN_TEXT = re.compile(r"\b(?:async (?=with|for)|await )")
"""In docstrings and comments, which unasync leaves alone."""


def made(name: str) -> str:
    """The text of one module of the synchronous half."""
    text = (PACKAGE / f"async_{name}.py").read_text()
    words = WORDS | {f"Async{ending}": ending for ending in CLASS.findall(text)}
    words["asyncio"] = "sync" if name == "live" else "time"  # websockets.asyncio; asyncio.sleep
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "_async" / f"{name}.py", Path(folder) / "_sync" / f"{name}.py"
        source.parent.mkdir()
        source.write_text(text)
        unasync.unasync_files([str(source)], [unasync.Rule("/_async/", "/_sync/", words)])
        text = HEADER.format(name=name) + WORD_IN_TEXT.sub("", result.read_text())
    target = ["--config", str(ROOT / "pyproject.toml"), "--stdin-filename", str(PACKAGE / f"{name}.py"), "-"]
    delegated = ["check", "--fix-only", "--quiet", "--unsafe-fixes", "--select=UP028"]  # yield from
    for command in (delegated, ["check", "--fix-only", "--quiet"], ["format", "--quiet"]):
        text = subprocess.run(
            [sys.executable, "-m", "ruff", *command, *target],
            input=text,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    return text


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; say what is not current")
    check = parser.parse_args().check
    stale = []
    for name in HALVES:
        path, text = PACKAGE / f"{name}.py", made(name)
        if not path.is_file() or path.read_text() != text:
            stale.append(path.name)
            if not check:
                path.write_text(text)
    if check and stale:
        raise SystemExit(f"not made of what async_*.py says now: {', '.join(stale)}; make sdk")
    print(f"{len(stale)} of {len(HALVES)} modules written" if not check else "current")


if __name__ == "__main__":
    main()
