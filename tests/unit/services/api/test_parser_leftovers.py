"""A child that dies while it reads leaves nothing in the temporary directory."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.service.hostile_files.corpus import Corpus, sound_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_services.api.parsing import ROOT, Parsers

pytestmark = pytest.mark.slow

DIES_IN_THE_LIBRARY = """
import os, signal, sys
import ezc3d
from physworld_services.api import parser_process

def crash(path):
    open(path).close()  # the importer's copy of the upload is there, and is left as it is
    os.kill(os.getpid(), signal.SIGSEGV)

ezc3d.c3d = crash
sys.exit(parser_process.main())
"""


@pytest.mark.parametrize("dies", [False, True], ids=["reads", "dies"])
def test_a_reader_leaves_its_files_in_the_uploads_folder(tmp_path: Path, dies: bool) -> None:
    """The library that reads C3D wants a file of its own; here it ends as on some forged files, or reads."""
    temporary, folder = tmp_path / "temporary", tmp_path / "upload"
    temporary.mkdir()
    folder.mkdir()
    (folder / "upload").write_bytes(Corpus(tmp_path, sound_bundle()).sound["arm.c3d"])
    words = ["-c", DIES_IN_THE_LIBRARY] if dies else ["-m", "physworld_services.api.parser_process"]
    request = {"folder": str(folder), "filename": "arm.c3d", "name": None, "options": {}}
    ended = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(temporary)},
        input=json.dumps(request) + "\n",
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(ended.stdout)["outcome"] == ("crashed" if dies else "read")
    assert len(list(folder.glob("**/*.c3d"))) == dies
    assert list(temporary.iterdir()) == []


def test_a_reader_that_nobody_holds_any_more_ends(tmp_path: Path) -> None:
    (tmp_path / "upload").write_bytes(b"no recording")
    parsers = Parsers(1)
    with pytest.raises(SceneInvalid):
        parsers.look(tmp_path, "some.npz", {})
    process = parsers._idle.queue[0]._process
    assert process is not None and process.poll() is None
    del parsers
    gc.collect()
    assert process.poll() is not None
