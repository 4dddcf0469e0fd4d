"""A local server that speaks the protocol of chat completions, for tests of the choice of a law."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class Model(BaseHTTPRequestHandler):
    """Answers as the server's ``status``, ``content`` (bytes) and ``delay_s`` say; remembers what it was asked."""

    def do_POST(self) -> None:
        server: Any = self.server
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        server.asked.append((self.path, dict(self.headers), body))
        if server.delay_s and server.asleep.wait(server.delay_s):
            return
        self.send_response(server.status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(server.content)))
        self.end_headers()
        self.wfile.write(server.content)

    def log_message(self, *arguments: object) -> None:
        """Says nothing."""


def completion(text: object) -> bytes:
    return json.dumps({"choices": [{"message": {"role": "assistant", "content": text}}]}).encode()


@contextmanager
def serving(answer: str) -> Iterator[Any]:
    """The server, which answers ``answer``; its address is in ``url``, what it was asked in ``asked``."""
    served: Any = ThreadingHTTPServer(("127.0.0.1", 0), Model)
    served.url = f"http://127.0.0.1:{served.server_address[1]}/v1"
    served.asked, served.status, served.content, served.delay_s = [], 200, completion(answer), 0.0
    served.asleep = threading.Event()
    thread = threading.Thread(target=served.serve_forever, daemon=True)
    thread.start()
    try:
        yield served
    finally:
        served.asleep.set()
        served.shutdown()
        served.server_close()
        thread.join()
