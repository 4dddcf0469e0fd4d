"""A child that dies while it reads leaves nothing in the temporary directory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.service.hostile_files.corpus import Corpus, sound_bundle
from physworld_services.api.parsing import ROOT

pytestmark = pytest.mark.slow

C3D_FILES = range(8, 11 * 60, 11)


def test_a_reader_that_dies_leaves_its_files_in_the_uploads_folder(tmp_path: Path) -> None:
    """Sixty bent C3D files: the library that reads them crashes or is stopped on about every tenth."""
    temporary, corpus, outcomes = tmp_path / "temporary", Corpus(tmp_path, sound_bundle()), []
    temporary.mkdir()
    words = [sys.executable, "-m", "physworld_services.api.parser_process"]
    environment, pipe = {**os.environ, "TMPDIR": str(temporary)}, subprocess.PIPE
    with subprocess.Popen(words, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, text=True) as parser:
        assert parser.stdin is not None and parser.stdout is not None
        for number in C3D_FILES:
            folder = tmp_path / str(number)
            folder.mkdir()
            (folder / "upload").write_bytes(corpus.file(number).content)
            request = {"folder": str(folder), "filename": "arm.c3d", "name": None, "options": {}}
            parser.stdin.write(json.dumps(request) + "\n")
            parser.stdin.flush()
            outcomes.append(json.loads(parser.stdout.readline())["outcome"])
        parser.stdin.close()
    assert set(outcomes) - {"read", "refused"}
    assert list(temporary.iterdir()) == []
