"""A TCP proxy that can fall silent: a server behind it then looks as one does whose process is stopped.

A stopped process is not a dead one. Its kernel still completes handshakes and acknowledges bytes, so neither a
refused connection nor TCP's own timers tell its clients. ``freeze`` does the same to whatever is behind the proxy:
connections stay open, new ones are established, bytes are taken, nothing answers. ``thaw`` lets everything flow on
from where it was, and ``cut`` resets the connections that are open.

    with FrozenProxy("127.0.0.1", 5432) as proxy:
        connect(proxy.host, proxy.port)
        proxy.freeze()
        proxy.thaw()

Nothing but the standard library is needed.
"""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress
from types import TracebackType

BACKLOG = 512  # connections that are established while nobody accepts them
CHUNK_BYTES = 65536
RESET = struct.pack("ii", 1, 0)  # SO_LINGER of zero seconds: closing sends a reset


class FrozenProxy:
    """Forwards connections from a free port of 127.0.0.1 to ``host``:``port`` unless it is frozen."""

    def __init__(self, host: str, port: int) -> None:
        self._target = (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=BACKLOG)
        self.host, self.port = self._listener.getsockname()[:2]
        self._lock = threading.Lock()
        self._flowing = threading.Event()
        self._flowing.set()
        self._closed = False
        self._open: set[socket.socket] = set()
        self._bytes_to_freeze: int | None = None
        self._forwarded = 0
        threading.Thread(target=self._accept, name="proxy-accept", daemon=True).start()

    def __enter__(self) -> FrozenProxy:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def forwarded(self) -> int:
        """Bytes that went through so far, both directions together."""
        return self._forwarded

    @property
    def connections(self) -> int:
        """Connections that are forwarded now; those that wait to be accepted are not counted."""
        with self._lock:
            return len(self._open) // 2

    @property
    def frozen(self) -> bool:
        """Whether nothing is forwarded now."""
        return not self._flowing.is_set()

    def freeze(self) -> None:
        """Forward nothing any more; connections stay open and new ones are established."""
        self._flowing.clear()

    def freeze_after(self, count: int) -> None:
        """Freeze once ``count`` more bytes have gone through, both directions together."""
        with self._lock:
            self._bytes_to_freeze = self._forwarded + count

    def thaw(self) -> None:
        """Forward again, first what was held back."""
        with self._lock:
            self._bytes_to_freeze = None
        self._flowing.set()

    def cut(self) -> None:
        """Reset every connection that is forwarded now; new ones are forwarded unless the proxy is frozen."""
        with self._lock:
            doomed, self._open = self._open, set()
        for end in doomed:
            _reset(end)

    def close(self) -> None:
        """Refuse new connections and reset those that are open."""
        self._closed = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the accepting thread
        self._listener.close()
        self.cut()
        self._flowing.set()

    def _accept(self) -> None:
        while not self._closed:
            self._flowing.wait()
            try:
                near, _address = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(near,), name="proxy-connection", daemon=True).start()

    def _serve(self, near: socket.socket) -> None:
        self._flowing.wait()
        try:
            far = socket.create_connection(self._target, timeout=10)
        except OSError:
            _reset(near)
            return
        far.settimeout(None)
        for end in (near, far):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._open |= {near, far}
        back = threading.Thread(target=self._pump, args=(far, near), name="proxy-back", daemon=True)
        back.start()
        self._pump(near, far)
        back.join()
        with self._lock:
            self._open -= {near, far}
        near.close()
        far.close()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        """Move bytes one way until the source ends; its end is passed on."""
        try:
            while data := source.recv(CHUNK_BYTES):
                self._flowing.wait()
                sink.sendall(data)
                self._count(len(data))
                self._flowing.wait()
            self._flowing.wait()
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            _reset(source)
            _reset(sink)

    def _count(self, count: int) -> None:
        with self._lock:
            self._forwarded += count
            if self._bytes_to_freeze is not None and self._forwarded >= self._bytes_to_freeze:
                self._bytes_to_freeze = None
                self._flowing.clear()


def _reset(end: socket.socket) -> None:
    """End a connection at once, also for a thread that waits for it."""
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        end.shutdown(socket.SHUT_RDWR)
    end.close()
