"""The web process as it is started: told by the environment, ended by a signal, no answer lost."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
from api_service import scene_id

TOKEN = "0123456789abcdef0123456789abcdef"
START_WITHIN_S = 60.0


def test_waiting_answers_are_given_when_the_process_is_told_to_stop(tmp_path: Path) -> None:
    environment = os.environ | {"PHYSWORLD_DATA_DIR": str(tmp_path), "PHYSWORLD_ADMIN_TOKEN": TOKEN}
    migrate = [sys.executable, "-m", "physworld_services.api.migrate"]
    subprocess.run(migrate, env=environment, check=True, capture_output=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    web = [sys.executable, "-m", "physworld_services.web", "--port", str(port)]
    with subprocess.Popen(web, env=environment, stderr=subprocess.PIPE) as process:
        try:
            answers = _wait_and_stop(f"http://127.0.0.1:{port}", process)
        finally:
            process.kill()
    assert answers["poll"].json()["state"] == "queued"
    assert answers["events"].text.startswith("id: 1")


def _wait_and_stop(url: str, process: subprocess.Popen[bytes]) -> dict[str, httpx.Response]:
    """A long poll and an event stream that would last, then SIGTERM; what they were answered."""
    options = {"base_url": url, "headers": {"Authorization": f"Bearer {TOKEN}"}, "trust_env": False}
    answers: dict[str, httpx.Response] = {}
    with httpx.Client(**options, timeout=60.0) as client:  # type: ignore[arg-type]
        _until_ready(client, process)
        job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()["id"]
        addresses = {"poll": f"/v1/jobs/{job}?wait=50", "events": f"/v1/jobs/{job}/events"}

        def ask(name: str) -> None:
            answers[name] = client.get(addresses[name])

        threads = [threading.Thread(target=ask, args=(name,)) for name in addresses]
        for thread in threads:
            thread.start()
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        for thread in threads:
            thread.join()
    assert process.stderr is not None
    errors = process.stderr.read().decode()
    assert process.wait() in (0, -signal.SIGTERM)
    assert '"level": "error"' not in errors, errors
    return answers


def _until_ready(client: httpx.Client, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_WITHIN_S
    while time.monotonic() < deadline:
        assert process.poll() is None
        try:
            if client.get("/health/ready").status_code == 200:
                return
        except httpx.ConnectError:
            pass
        time.sleep(0.1)
    raise AssertionError(f"not ready after {START_WITHIN_S} s")
