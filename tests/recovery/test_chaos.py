"""The chaos suite in its short form: eight kills and other faults on each deployment lose and double nothing."""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from benchmarks.service.chaos import plan, processes
from benchmarks.service.chaos.clocks import Clock, clock_library
from benchmarks.service.chaos.distributed import initdb_binary
from benchmarks.service.chaos.store_proxy import RefusingProxy

KILLS, SEED = 8, 1
NOTHING = (
    "episodes_lost", "episodes_doubled", "episodes_corrupt", "jobs_lost", "pipelines_lost", "pipelines_doubled",
    "models_missing", "models_doubled", "models_corrupt", "files_missing",
)  # fmt: skip


def ledger_of(deployment: str, repository: Path, folder: Path) -> dict[str, object]:
    """Run the command as a person would, in a process of its own."""
    file = folder / "ledger.json"
    command = [
        sys.executable,
        "-m",
        "benchmarks.service.chaos",
        "--deployment",
        deployment,
        "--seed",
        str(SEED),
    ]
    limits = ["--kills", str(KILLS), "--minutes", "4", "--settle", "180", "--json", str(file)]
    done = subprocess.run([*command, *limits], cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, object] = json.loads(file.read_text())
    return found


def expect_nothing_lost(found: dict[str, object]) -> None:
    assert found["kills"] == KILLS
    assert {name: found[name] for name in NOTHING} == dict.fromkeys(NOTHING, 0)
    assert found["models_published"] == found["pipelines"] > 0  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_eight_kills_of_the_embedded_service(repository: Path, tmp_path: Path) -> None:
    expect_nothing_lost(ledger_of("embedded", repository, tmp_path))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_eight_kills_of_the_distributed_service(repository: Path, tmp_path: Path) -> None:
    if initdb_binary() is None and not os.environ.get("PHYSWORLD_TEST_POSTGRES_URL"):
        pytest.skip("no initdb of Postgres is installed, and PHYSWORLD_TEST_POSTGRES_URL names no server")
    expect_nothing_lost(ledger_of("distributed", repository, tmp_path))


def test_the_same_seed_draws_the_same_faults_and_each_round_kills_every_part() -> None:
    targets = ("worker", "web", "broker")
    drawn = [[next(faults) for _ in range(6)] for faults in (plan.kills(3, targets), plan.kills(3, targets))]
    assert drawn[0] == drawn[1]
    for round_of in (drawn[0][:3], drawn[0][3:]):
        assert sorted(fault.target for fault in round_of) == sorted(targets)
    assert drawn[0] != [next(plan.kills(4, targets)) for _ in range(6)]


def test_a_wall_clock_is_stepped_and_sleeps_and_monotonic_clocks_are_not(tmp_path: Path) -> None:
    library = clock_library(tmp_path)
    if library is None:
        pytest.skip("no C compiler, or not Linux")
    clock = Clock(library, tmp_path / "clock")
    code = (
        "import sqlite3, sys, time\n"
        "ask = sqlite3.connect(':memory:').execute\n"
        "for line in sys.stdin:\n"
        "    began = time.monotonic(); time.sleep(0.1); slept = time.monotonic() - began\n"
        "    told = ask(\"SELECT (julianday('now') - 2440587.5) * 86400\").fetchone()[0]\n"
        "    print(time.time(), told, time.monotonic(), slept, flush=True)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], env=processes.environment(**clock.variables), stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip
        assert child.stdin is not None and child.stdout is not None
        for step_s in (0.0, 17.5, -30.0, 0.0):
            clock.step(step_s)
            child.stdin.write("\n")
            child.stdin.flush()
            told = [float(part) for part in child.stdout.readline().split()]
            assert told[0] - time.time() == pytest.approx(step_s, abs=5.0)
            assert told[1] - time.time() == pytest.approx(step_s, abs=5.0)
            assert told[2] - time.monotonic() == pytest.approx(0.0, abs=5.0)
            assert 0.1 <= told[3] < 5.0
        child.stdin.close()


def test_a_proxy_falls_silent_refuses_writes_and_is_mended() -> None:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            self.send_response(200)
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"ok")

        do_PUT = do_GET

        def log_message(self, format: str, *arguments: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    proxy = RefusingProxy("127.0.0.1", server.server_port)

    def status(method: str, timeout: float = 20.0) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", proxy.port, timeout=timeout)
        try:
            connection.request(method, "/", body=b"x" * 1000 if method == "PUT" else None)
            return connection.getresponse().status
        finally:
            connection.close()

    try:
        assert (status("GET"), status("PUT")) == (200, 200)
        for refused in (403, 503, 507):
            proxy.refuse(refused)
            assert (status("GET"), status("PUT")) == (200, refused)
        proxy.mend()
        proxy.freeze()
        began = time.monotonic()
        with pytest.raises(TimeoutError):
            status("GET", timeout=0.5)
        assert time.monotonic() - began >= 0.5
        proxy.mend()
        assert (status("GET"), status("PUT")) == (200, 200)
    finally:
        proxy.close()
        server.shutdown()
        server.server_close()
