"""A proxy before an S3 server that can also refuse what writes, as a full or a read-only store does."""

from __future__ import annotations

import socket
from typing import Any

from benchmarks.service.chaos.proxy import CHUNK_BYTES, FrozenProxy

DRAIN_S = 1.0
WRITES = (b"PUT ", b"POST ", b"DELETE ")
REASONS = {
    403: ("Forbidden", "AccessDenied"),
    503: ("Service Unavailable", "SlowDown"),
    507: ("Insufficient Storage", "InsufficientStorage"),
}


class RefusingProxy(FrozenProxy):
    """A proxy that answers HTTP requests that write with a status of its own while ``refused`` is one."""

    refused: int = 0

    def refuse(self, status: int) -> None:
        """From now on PUT, POST and DELETE are answered with 403, 503 or 507; reads pass."""
        self.refused = status

    def mend(self) -> None:
        """Everything passes again."""
        self.refused = 0
        self.thaw()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            asks = sink.getpeername()[1] == self._target[1]
        except OSError:  # the connection has ended meanwhile
            asks = False
        super()._pump(_Asking(self, source) if asks else source, sink)


class _Asking:
    """The client's end of a connection; a request that is refused ends the stream of its bytes."""

    def __init__(self, proxy: RefusingProxy, end: socket.socket) -> None:
        self._proxy, self._end = proxy, end

    def recv(self, size: int) -> bytes:
        data = self._end.recv(size)
        if self._proxy.refused and data.startswith(WRITES):
            _answer(self._end, self._proxy.refused)
            return b""
        return data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._end, name)


def _answer(client: socket.socket, status: int) -> None:
    """Refuse one request and take what is left of its body, so that the answer is not lost to a reset."""
    reason, code = REASONS[status]
    body = f"<Error><Code>{code}</Code><Message>refused by the proxy</Message></Error>".encode()
    head = (
        f"HTTP/1.1 {status} {reason}\r\nContent-Type: application/xml\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    client.sendall(head.encode() + body)
    client.shutdown(socket.SHUT_WR)
    client.settimeout(DRAIN_S)
    while client.recv(CHUNK_BYTES):
        pass
