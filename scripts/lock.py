"""Write ``requirements.lock``: every package that any extra needs, its version, its digests, who needs it.

``make lock`` keeps the versions that the lock holds and adds what is new in ``pyproject.toml``; ``make lock
UPGRADE=name`` (or ``UPGRADE=all``) moves one package, or all, to their newest releases. The resolver is uv, which is
installed beside the environment for this and nothing else. The lock holds the digests of every file that the index
has of a release, so that any platform can be installed from it.

torch is named apart: its CPU build lies on an index of its own, and its plain build brings gigabytes of CUDA libraries.
The lock holds the digest of the CPU build's file for this platform, which pip is asked for.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"
PYTHON = "3.11"
SETUPTOOLS = "setuptools==84.2.1"  # what builds the two distributions
TORCH = "2.13.0"
OF_CUDA = re.compile(r"^(torch$|triton$|cuda-|nvidia-)")


def wanted() -> dict[str, list[str]]:
    """What each extra asks for, with the client's requirements among those of the distribution."""
    project, client = (
        tomllib.loads((ROOT / path).read_text())["project"]
        for path in ("pyproject.toml", "clients/python/pyproject.toml")
    )
    base = [line for line in client["dependencies"] if line != "physworld"]
    base += [*project["dependencies"], *client["optional-dependencies"]["export"], SETUPTOOLS]
    extras = project["optional-dependencies"]
    found = {"base": base, **{extra: [*base, *lines] for extra, lines in extras.items()}}
    found["bootstrap"] = ["virtualenv"]  # for machines whose Python has no ensurepip
    return {
        extra: [f"torch=={TORCH}" if line == "torch" else line for line in lines]
        for extra, lines in found.items()
    }


def compiled(lines: list[str], held: Path, folder: Path) -> dict[str, str]:
    """All packages that these requirements need, each with its text: version, marker, digests."""
    asked, out = folder / "asked.in", folder / "lock.txt"
    asked.write_text("\n".join(lines) + "\n")
    out.unlink(missing_ok=True)
    command = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--universal", "--generate-hashes"]
    command += ["--python-version", PYTHON, "--no-annotate", "--no-header", "--constraint", str(held)]
    subprocess.run([*command, str(asked), "--output-file", str(out)], check=True)
    texts: dict[str, str] = {}
    name = ""
    for line in out.read_text().splitlines(keepends=True):
        if not line.startswith(" "):
            name = re.split(r"[=\s;]", line)[0]
            texts[name] = ""
        texts[name] += line
    return {name: text for name, text in texts.items() if not OF_CUDA.match(name)}


def torch_entry(folder: Path) -> str:
    """The CPU build of torch with the digest of the file that pip finds for this platform."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder)]
    subprocess.run([*command, f"torch=={TORCH}+cpu"], check=True)
    (file,) = folder.glob("torch-*.whl")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return f"torch=={TORCH}+cpu \\\n    --hash=sha256:{digest}\n"


def held_versions(upgraded: str) -> list[str]:
    """The versions that stay as they are: those of the present lock without the upgraded ones."""
    if upgraded == "all" or not LOCK.is_file():
        return []
    lines = [line for line in LOCK.read_text().splitlines() if re.match(r"^[a-z0-9]", line)]
    pins = [re.split(r"[\s;]", line)[0] for line in lines]
    return [pin for pin in pins if pin.split("==")[0] not in {"torch", upgraded}]


def main() -> int:
    """Resolve every extra under the same versions and write the lock."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--upgrade", default="", help="a package, or 'all'")
    options = parser.parse_args()
    extras = wanted()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        held = folder / "held.txt"
        held.write_text("\n".join(held_versions(options.upgrade)) + "\n")
        whole = compiled(sorted({line for lines in extras.values() for line in lines}), held, folder)
        held.write_text("\n".join(text.split(" ", 1)[0] for text in whole.values()) + "\n")
        needs = {extra: set(compiled(sorted(set(lines)), held, folder)) for extra, lines in extras.items()}
        entries = []
        for package, text in sorted(whole.items()):
            named = [extra for extra in extras if package in needs[extra]]
            if "base" in named:
                named = [extra for extra in named if extra in {"base", "bootstrap"}]
            entries.append(f"# {' '.join(named)}\n{text}")
        entries.append("# torch\n" + torch_entry(folder))
    LOCK.write_text("".join(entries))
    print(f"{LOCK.name}: {len(entries)} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main())
