"""``python -m scripts.stumbles [--only N]``: what new users stumbled over, each with the test that was seen to fail.

For each stumble a line of the product is broken in a copy of the tracked files, the test is run there and has to fail,
and to pass once the line stands again. ``--only`` takes the number of one stumble. The table of docs/stumbles.md is
what it prints.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CLIENT = "clients/python/physworld_client"
DASHBOARD = "services/dashboard"
COMMANDS = "tests/contract/sdk/test_command_line_verbs.py"
STUMBLES = "tests/unit/clients/test_client_stumbles.py"
OBJECTS = "tests/unit/clients/test_client_objects.py"
SERVICE = "tests/unit/services/test_stumbles.py"
LOCATION = "tests/unit/clients/test_client_location.py"
PROBLEMS = "tests/contract/api/test_api_problems.py"


@dataclass(frozen=True)
class Stumble:
    """What people met, the test, and how the product is broken to see the test fail: a text of a file and another."""

    told: str
    test: str
    path: str
    text: str
    broken: str


FOUND = (
    Stumble(
        "Units in brackets were swallowed in tables",
        f"{LOCATION}::test_units_in_brackets_are_printed_as_they_are",
        f"{CLIENT}/cli/output.py",
        "table.add_column(Text(heading)",
        "table.add_column(heading",
    ),
    Stumble(
        "Lists showed ids that no other command took",
        f"{STUMBLES}::test_a_list_shows_whole_ids_that_the_next_command_takes",
        f"{CLIENT}/cli/lists.py",
        "return (fit.id, fit.scene_id,",
        "return (fit.id[-6:], fit.scene_id,",
    ),
    Stumble(
        "An explicit --data did not count before the environment",
        f"{LOCATION}::test_a_data_folder_on_the_command_line_counts_before_the_address_in_the_environment",
        f"{CLIENT}/cli/service.py",
        "if url is None and data is None:",
        "if url is None:",
    ),
    Stumble(
        "Client() knew no service that ran on this machine",
        f"{LOCATION}::test_the_embedded_service_is_found_with_its_key",
        f"{CLIENT}/location.py",
        '"run" / "state.json"',
        '"state.json"',
    ),
    Stumble(
        "A restart took another port",
        f"{SERVICE}::test_the_port_of_the_last_run_is_remembered",
        "services/embedded/folder.py",
        "return port if 0 < port < 65536 else 0",
        "return 0",
    ),
    Stumble(
        "Messages began with the name of an exception's class",
        "tests/unit/schemas/test_wording.py::test_the_reason_of_an_exception_never_names_its_class",
        "schemas/wording.py",
        'text = " ".join(str(error).split())',
        'text = f"{type(error).__name__}: {error}"',
    ),
    Stumble(
        "An output file of another ending was written all the same",
        f"{COMMANDS}::test_an_output_whose_ending_is_another_forms_is_refused",
        f"{CLIENT}/cli/options.py",
        "if path is None or path.suffix.lower() in suffixes or",
        "if True or path.suffix.lower() in suffixes or",
    ),
    Stumble(
        "physworld --version did not exist",
        f"{LOCATION}::test_the_version_is_an_option_too",
        f"{CLIENT}/cli/app.py",
        '"--version"',
        '"--release"',
    ),
    Stumble(
        "A mistyped setting was refused without the one that was meant",
        "tests/unit/schemas/test_wording.py::test_an_unknown_key_is_told_with_the_nearest_one",
        "schemas/wording.py",
        "    if close:\n",
        "    if False:\n",
    ),
    Stumble(
        "Problems had empty hints",
        f"{SERVICE}::test_a_problem_has_a_hint_that_helps_or_none_at_all",
        "services/api/errors.py",
        'exclude={"hint"} if problem.hint is None else None',
        "exclude=None",
    ),
    Stumble(
        "A search that spent its budget read ready",
        f"{SERVICE}::test_a_search_that_spent_its_budget_is_not_called_ready",
        f"{DASHBOARD}/templates/macros.html",
        "and fit.search and not fit.search.converged",
        "and fit.search and false",
    ),
    Stumble(
        "Settings that are lists were printed as code",
        f"{SERVICE}::test_lists_of_settings_are_words_and_no_code",
        f"{DASHBOARD}/text.py",
        "if isinstance(value, list | tuple):\n        return",
        "if False:\n        return",
    ),
    Stumble(
        "Progress and time left were of the present stage, not of the job",
        f"{STUMBLES}::test_the_time_left_and_the_share_are_of_the_whole_job",
        f"{CLIENT}/cli/output.py",
        "100 * job.share",
        "100 * progress.done / progress.total",
    ),
    Stumble(
        "A missing matplotlib was a traceback of an import",
        f"{OBJECTS}::test_a_missing_package_names_the_extra_that_brings_it",
        f"{CLIENT}/errors.py",
        "pip install 'physworld-client[{extra}]'",
        "see the documentation",
    ),
    Stumble(
        "A world model printed all of its arrays",
        f"{OBJECTS}::test_arrays_are_shown_by_their_shapes",
        f"{CLIENT}/world_model.py",
        "def __repr__(self)",
        "def shown(self)",
    ),
    Stumble(
        "Types of answers had to be imported from the service's package",
        f"{OBJECTS}::test_every_type_of_the_resources_is_in_the_module_of_types",
        f"{CLIENT}/types.py",
        '    "LocalStage",\n',
        "",
    ),
    Stumble(
        "Plots pressed the result into a line under its baselines",
        f"{OBJECTS}::test_errors_are_drawn_in_millimetres_with_the_floor_and_a_logarithm_where_baselines_dwarf",
        f"{CLIENT}/plots.py",
        'axes.set_yscale("log")',
        'axes.set_yscale("linear")',
    ),
    Stumble(
        "A download told nothing until it was over",
        "tests/unit/clients/test_client_progress.py::test_a_download_moves_its_bar_to_the_end",
        f"{CLIENT}/artifacts.py",
        "bar.moves(len(chunk))",
        "pass",
    ),
    Stumble(
        "Allow named the first method of an address only",
        f"{PROBLEMS}::test_allow_names_every_method_of_an_address",
        "services/api/errors.py",
        "if status == 405:",
        "if status == 0:",
    ),
    Stumble(
        "A body in another encoding was a status that the document did not have",
        f"{PROBLEMS}::test_a_body_that_is_no_text_is_refused_as_the_document_says",
        "services/api/errors.py",
        "if detail == UNREAD:",
        "if False:",
    ),
    Stumble(
        "true was taken for the number one",
        f"{SERVICE}::test_true_is_no_number_of_minutes",
        "schemas/base.py",
        "if isinstance(value.get(name), bool) and",
        "if False and",
    ),
    Stumble(
        "A search word with % or _ found everything",
        "tests/unit/storage/test_storage_search.py::test_a_scene_is_found_by_words_of_its_name_in_any_case_and_order",
        "storage/search.py",
        "autoescape=True)\n",
        "autoescape=False)\n",
    ),
)


def seen_to_fail(stumble: Stumble, folder: Path) -> str:
    """Break the product in a copy, run the test broken and whole; what went wrong, empty where nothing did."""
    file = folder / stumble.path
    whole = file.read_text()
    if whole.count(stumble.text) < 1:
        return f"{stumble.path} holds no {stumble.text!r}"
    file.write_text(whole.replace(stumble.text, stumble.broken))
    broken = _passes(stumble.test, folder)
    file.write_text(whole)
    if broken:
        return "the test passes with the product broken"
    return "" if _passes(stumble.test, folder) else "the test fails with the product whole"


def _passes(test: str, folder: Path) -> bool:
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder / "build" / "packages"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{test}: {done.stdout.decode()[-2000:]}{done.stderr.decode()[-2000:]}")
    return done.returncode == 0


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--only", type=int, help="number of one stumble")
    only = parser.parse_args().only
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        _copy(folder)
        print("| | stumble | test that was seen to fail |\n|---|---|---|", flush=True)
        for number, stumble in enumerate(FOUND, 1):
            if only in (None, number):
                fault = seen_to_fail(stumble, folder)
                wrong += bool(fault)
                place, _, test = stumble.test.partition("::")
                print(
                    f"| {number} | {stumble.told} | `{Path(place).name}`: {fault or test.replace('_', ' ')} |",
                    flush=True,
                )
    raise SystemExit(f"{wrong} were not seen to fail" if wrong else 0)


def _copy(folder: Path) -> None:
    """The tracked files, and links from the import names to their folders as in an installation."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for path in filter(None, listed.decode().split("\0")):
        if (ROOT / path).is_file():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes((ROOT / path).read_bytes())
    packages = folder / "build" / "packages"
    packages.mkdir(parents=True)
    for room in ("scenes", "schemas", "services", "storage", "workers"):
        (packages / f"physworld_{room}").symlink_to(folder / room)
    (packages / "physworld").symlink_to(folder / "physworld")
    (packages / "physworld_client").symlink_to(folder / CLIENT)
    (packages / "physworld_sample").symlink_to(folder / "sample")


if __name__ == "__main__":
    main()
