"""Access control of the console: its own pages only, and from other machines only with the token."""

from __future__ import annotations

import errno
import hmac
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pendulum_msgs_py.errors import ParameterError

__all__ = ["LOOPBACK", "Guard", "is_loopback", "listen", "refusal"]

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1", "[::1]"})
COOKIE = "pendulum_console"

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


def is_loopback(host: str) -> bool:
    """Return whether a host to listen on can be reached from this machine only."""
    return host in LOOPBACK


def listen(host: str, port: int, backlog: int = 1) -> socket.socket:
    """Return a listening socket, port 0 for any; a ParameterError if address or port are not available."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family, backlog=backlog)
    except socket.gaierror:
        raise ParameterError(
            f"host is {host!r}, which is no address of this machine; expected such as 0.0.0.0"
        ) from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ParameterError(
                f"port is {port}, which another program listens on; expected a free one: --port PORT"
            ) from None
        raise ParameterError(f"host is {host!r}, port {port}: {error.strerror or error}") from None


def refusal(headers: dict[str, str], query: str, token: str) -> str:
    """Return why a request is refused, or an empty text; ``headers`` are by lower-case name.

    Another site in the same browser could send requests (with its own ``Origin``), or impersonate the console under a
    name that it resolves to this machine (``Host``). ``token`` is empty on loopback.
    """
    host = headers.get("host", "")
    name = urlsplit(f"//{host}").hostname or ""
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return f"origin {origin} is another site; expected http://{host}"
    if not token:
        return "" if is_loopback(name) else f"host {host!r} is not this machine; expected localhost"
    cookies = SimpleCookie(headers.get("cookie", ""))
    given = parse_qs(query).get("token", [cookies[COOKIE].value if COOKIE in cookies else ""])[0]
    if hmac.compare_digest(given.encode(), token.encode()):
        return ""
    return "the token is missing or wrong; open the address that the console printed at its start"


class Guard:
    """ASGI middleware that calls :func:`refusal` before every request and websocket."""

    def __init__(self, app: Callable[[Scope, Receive, Send], Awaitable[None]], token: str = "") -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        reason = refusal(headers, scope["query_string"].decode("latin-1"), self._token)
        if not reason:
            await self._app(scope, receive, self._keep(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 4403, "reason": reason[:120]})
        else:
            plain = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": 403, "headers": plain})
            await send({"type": "http.response.body", "body": reason.encode()})

    def _keep(self, send: Send) -> Send:
        """Return a ``send`` that sets the token as a cookie for the page's own requests."""
        if not self._token:
            return send

        async def send_with_cookie(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                cookie = f"{COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                message["headers"] = [*message.get("headers", []), (b"set-cookie", cookie.encode())]
            await send(message)

        return send_with_cookie
