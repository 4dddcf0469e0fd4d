"""The documentation says what is there: links, command lines, settings, addresses, keys of a scene.

Command lines are parsed with ``--help`` behind them: an unknown command or option fails, nothing runs.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner
from physworld_client.cli.app import app
from typer.main import get_command

from physworld_scenes.bundle import FIELD_OF_ARRAY
from physworld_scenes.declaration import BodyForm, ColliderForm, Declaration, GripForm, GroundForm
from physworld_schemas.hints import HINTS
from physworld_services.web import create_app
from physworld_storage.settings import Settings

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
CLI = get_command(app)

CODE_BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)
COMMAND = re.compile(r"^ *(physworld [^\n]*)$", re.MULTILINE)
INLINE_COMMAND = re.compile(r"`(physworld [^`]*)`")
GENERATED = re.compile(
    r"<!-- (?:catalogue )?(?P<name>[\w. ]+?):? ?(?:begin )?-->.*?<!-- (?:(?P=name):? ?end|end of (?P=name)) -->",
    re.DOTALL,
)
MOST_WORDS = 23_000
MOST_WORDS_OF_A_PAGE = 1_800
ADDRESS = re.compile(r"`(GET|POST|PUT|PATCH|DELETE) (/[^`]*)`")


def anchors(text: str) -> set[str]:
    """Targets of ``#anchor`` links, as GitHub makes them from headings."""
    titles = HEADING.findall(CODE_BLOCK.sub("", text))
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def command_lines() -> list[tuple[str, str]]:
    """(page, command line) of every command quoted in a code block or inline."""
    found = []
    for page, name in zip(PAGES, NAMES, strict=True):
        text = page.read_text()
        blocks = "\n".join(CODE_BLOCK.findall(text))
        commands = COMMAND.findall(blocks) + INLINE_COMMAND.findall(CODE_BLOCK.sub("", text))
        found += [(name, command) for command in commands]
    return found


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_relative_links_resolve(page: Path) -> None:
    broken = []
    for target in LINK.findall(CODE_BLOCK.sub("", page.read_text())):
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        goal = page if not path else (page.parent / path)
        if not goal.exists() or (anchor and anchor not in anchors(goal.read_text())):
            broken.append(target)
    assert not broken


def test_there_are_command_lines_to_check() -> None:
    assert len(command_lines()) > 20


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_quoted_command_lines_parse(page: str, line: str) -> None:
    words = shlex.split(line, comments=True)[1:]
    result = CliRunner().invoke(CLI, [*words, "--help"])
    assert result.exit_code == 0, f"{page}: {line}\n{result.output}"


def test_the_table_of_settings_is_the_settings() -> None:
    page = (ROOT / "docs" / "operations.md").read_text()
    table = page.partition("<!-- settings:begin -->")[2].partition("<!-- settings:end -->")[0]
    documented = dict(re.findall(r"^\| `PHYSWORLD_(\w+)` \| ([^|]*) \|", table, re.MULTILINE))
    fields = {name.upper(): field.get_default() for name, field in Settings.model_fields.items()}
    assert set(documented) == set(fields)
    plain = {
        name: value for name, value in fields.items() if isinstance(value, str | int | float) and value != ""
    }
    wrong = {name: value for name, value in plain.items() if documented[name] != f"`{value}`"}
    assert set(wrong) == set()


def test_the_table_of_addresses_is_the_api(tmp_path: Path) -> None:
    paths = create_app(Settings(data_dir=tmp_path)).openapi()["paths"]
    served = {(method.upper(), path) for path, methods in paths.items() for method in methods}
    page = (ROOT / "docs" / "api.md").read_text()
    documented = {pair for pair in ADDRESS.findall(page) if pair[1] != "/metrics"}
    assert documented == served


def test_a_hint_names_a_page_that_says_it() -> None:
    pages = set(re.findall(r"docs/\w+\.md", " ".join(HINTS.values())))
    assert {page for page in pages if not (ROOT / page).is_file()} == set()
    upload = (ROOT / "docs" / "api.md").read_text().partition("## Upload\n")[2].partition("\n## ")[0]
    assert HINTS["content_too_large"].endswith("docs/api.md names the limits under Upload.")
    assert "PHYSWORLD_MAX_UPLOAD_BYTES" in upload and "1 MiB" in upload


def test_the_commands_of_a_worker_elsewhere_name_every_variable_of_its_store() -> None:
    page = (ROOT / "docs" / "howto" / "twenty_machines.md").read_text()
    wanted = {
        "DATABASE_URL",
        "BROKER_URL",
        "STORE_URL",
        *(n.upper() for n in Settings.model_fields if "s3_" in n),
    }
    [block] = [one for one in CODE_BLOCK.findall(page) if "physworld_workers" in one]
    assert set(re.findall(r"PHYSWORLD_(\w+)=", block)) == wanted


def test_every_key_of_a_scene_is_documented() -> None:
    page = (ROOT / "docs" / "scenes.md").read_text()
    forms = (Declaration, BodyForm, GroundForm, GripForm, ColliderForm)
    keys = {key for form in forms for key in form.model_fields} | set(FIELD_OF_ARRAY)
    assert {key for key in keys if f"`{key}`" not in page} == set()


def counted(text: str) -> int:
    """Words, numbers and names; no lines of tables and no signs."""
    return sum(any(letter.isalnum() for letter in word) for word in text.split())


def test_the_pages_that_teach_have_no_more_words_than_they_may() -> None:
    """Outside what scripts write between their marks, and outside the section Evidence of the guide."""
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    evidence = set(re.findall(r": (\S+\.md)$", navigation.partition("- Evidence:")[2], re.MULTILINE))
    assert {"benchmarks.md", "measured.md", "verification.md", "paper.md"} <= evidence
    pages = [*ROOT.glob("docs/*.md"), *ROOT.glob("docs/howto/*.md"), ROOT / "README.md"]
    taught = [page for page in pages if page.name not in evidence]
    words = {page.name: counted(GENERATED.sub("", page.read_text())) for page in taught}
    assert sum(words.values()) <= MOST_WORDS, sorted(words.items(), key=lambda pair: -pair[1])
    assert max(words.values()) <= MOST_WORDS_OF_A_PAGE, sorted(words.items(), key=lambda pair: -pair[1])[:3]


def test_what_scripts_write_below_their_tables_is_folded() -> None:
    """Machine and versions of a measurement stand in no page's readable flow."""
    open_lines = []
    for page, name in zip(PAGES, NAMES, strict=True):
        shown = re.sub(r"<details.*?</details>", "", page.read_text(), flags=re.DOTALL)
        open_lines += [name for line in shown.splitlines() if re.match(r"_`python -m benchmarks\S*`;", line)]
    assert open_lines in (
        [],
        ["docs/measured.md"],
    )  # of the terms of a rod, a table that stands there by hand
