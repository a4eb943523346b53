"""The gate before the websocket server: admits clients and carries bytes in both directions.

The server's library checks neither token nor origin, so it listens on an address that only this program knows.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable

from pendulum_console.console.security import listen
from pendulum_console.live.handshake import Request, as_asked, parse, to_server
from pendulum_msgs_py.errors import FaultError

__all__ = ["Gate"]

_PAUSE = 0.004
"""Pause after each delivery to a client [s]: messages in between are sent together, for a tenth of the CPU time."""
_PIECE = 1 << 18
_LONGEST_HEAD = 16384
_HANDSHAKE_TIME = 5.0
_MOST_CLIENTS = 16
_END = b"\r\n\r\n"


class Gate:
    """Listens at ``port`` (0 for any), and connects admitted clients to a server at an address and port.

    ``refusal`` returns why a request is refused, or nothing; ``report`` gets a line on each client; both are called in
    any thread. A ParameterError if address or port are not available.
    """

    def __init__(
        self,
        host: str,
        port: int,
        server: tuple[str, int],
        refusal: Callable[[Request], str],
        report: Callable[[str], None],
    ) -> None:
        self._server = server
        self._refusal = refusal
        self._report = report
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._closing = False
        self._listener = listen(host, port, _MOST_CLIENTS)
        self.port: int = self._listener.getsockname()[1]
        self._start(self._accept)

    def close(self) -> None:
        """Stop listening, and close all connections."""
        with self._lock:
            self._closing = True
            sockets = [self._listener, *self._open]
        for each in sockets:
            _hang_up(each)
        self._listener.close()

    def _start(self, work: Callable[..., None], *arguments: object) -> None:
        threading.Thread(target=work, args=arguments, name="gate", daemon=True).start()

    def _accept(self) -> None:
        while not self._closing:
            try:
                client, address = self._listener.accept()
            except OSError:
                if not self._closing:
                    time.sleep(0.1)  # no descriptors left, or a client that has gone already
                continue
            with self._lock:
                full = len(self._open) >= 2 * _MOST_CLIENTS or self._closing
                if not full:
                    self._open.add(client)
            if full:
                client.close()
            else:
                self._start(self._attend, client, f"{address[0]}:{address[1]}")

    def _attend(self, client: socket.socket, who: str) -> None:
        with contextlib.ExitStack() as leaving:
            leaving.callback(self._forget, client)
            try:
                server = self._admit(client, who)
                if server is None:
                    return
                leaving.callback(self._forget, server)
                self._report(f"{who} is connected")
                leaving.callback(self._report, f"{who} has gone")
                self._start(_carry, server, client, _PAUSE)
                _carry(client, server, 0.0)
            except OSError:
                return

    def _admit(self, client: socket.socket, who: str) -> socket.socket | None:
        client.settimeout(_HANDSHAKE_TIME)
        head, rest = _read_head(client)
        try:
            request = parse(head)
        except FaultError as error:
            self._refuse(client, "400 Bad Request", str(error), who)
            return None
        if why := self._refusal(request):
            self._refuse(client, "403 Forbidden", why, who)
            return None
        if not request.is_websocket:
            host = request.headers.get("host", f"localhost:{self.port}")
            query = f"?{request.query}" if request.query else ""
            said = f"This is no page. Open a connection to ws://{host}/{query} in Foxglove or Lichtblick."
            self._refuse(client, "426 Upgrade Required", said, "")
            return None
        server = socket.create_connection(self._server, timeout=_HANDSHAKE_TIME)
        with self._lock:
            self._open.add(server)
        server.sendall(to_server(head) + rest)
        answer, rest = _read_head(server)
        client.sendall(as_asked(answer, request) + rest)
        for each in (client, server):
            each.settimeout(None)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return server

    def _refuse(self, client: socket.socket, status: str, why: str, who: str) -> None:
        text = f"{why}\n".encode()
        head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(text)}\r\n"
        client.sendall(f"{head}Connection: close\r\n\r\n".encode() + text)
        if who:
            self._report(f"{who} is refused: {why}")

    def _forget(self, each: socket.socket) -> None:
        with self._lock:
            self._open.discard(each)
        _hang_up(each)
        each.close()


def _read_head(source: socket.socket) -> tuple[bytes, bytes]:
    data = b""
    while _END not in data:
        piece = source.recv(4096)
        if not piece or len(data) > _LONGEST_HEAD:
            raise ConnectionError("no head of HTTP")
        data += piece
    end = data.index(_END) + len(_END)
    return data[:end], data[end:]


def _carry(source: socket.socket, sink: socket.socket, pause: float) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(_PIECE):
            sink.sendall(data)
            if pause:
                time.sleep(pause)
    _hang_up(source)
    _hang_up(sink)


def _hang_up(each: socket.socket) -> None:
    with contextlib.suppress(OSError):
        each.shutdown(socket.SHUT_RDWR)
