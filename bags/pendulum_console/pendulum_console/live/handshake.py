"""Access control of websockets: local programs and viewers, pages that the user named (by ``Origin``), the token."""

from __future__ import annotations

import hmac
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from pendulum_console.console.security import is_loopback
from pendulum_msgs_py.errors import FaultError

__all__ = ["VIEWERS", "Request", "as_asked", "parse", "refusal", "to_server"]

VIEWERS = frozenset({"https://app.foxglove.dev", "file://"})
"""Admitted origins in addition to this machine's: Foxglove in a browser, and desktop programs (Electron)."""
NEWER = "foxglove.sdk.v1"
OLDER = "foxglove.websocket.v1"
"""Older name of the same protocol, which Lichtblick requests."""
_PROTOCOL = "sec-websocket-protocol"


@dataclass(frozen=True)
class Request:
    """A request for a websocket: the address's query, and the headers by lower-case name."""

    query: str
    headers: Mapping[str, str]

    @property
    def is_websocket(self) -> bool:
        """Whether a websocket is requested, and not a page."""
        return self.headers.get("upgrade", "").lower() == "websocket"

    @property
    def protocols(self) -> list[str]:
        """The client's protocols, in its order."""
        return [name.strip() for name in self.headers.get(_PROTOCOL, "").split(",") if name.strip()]


def parse(head: bytes) -> Request:
    """Parse a request's head, including its empty line; a FaultError if it is not HTTP."""
    first, *lines = head.decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/"):
        raise FaultError("this is no request of HTTP; expected one for a websocket")
    pairs = (line.partition(":") for line in lines if line)
    return Request(urlsplit(words[1]).query, {name.strip().lower(): value.strip() for name, _, value in pairs})


def refusal(request: Request, token: str, origins: Collection[str] = ()) -> str:
    """Return why a request is refused, or an empty text; ``token`` is empty on loopback, ``origins`` need none."""
    if token:
        given = parse_qs(request.query).get("token", [""])[0]
        if hmac.compare_digest(given.encode(), token.encode()):
            return ""
        return "the token is missing or wrong; open the address that was printed at the start"
    origin = request.headers.get("origin")
    if origin is None or origin in VIEWERS or origin in origins or is_loopback(urlsplit(origin).hostname or ""):
        return ""
    return f"the page of {origin} is none of this machine; --origin {origin} lets it in"


def to_server(head: bytes) -> bytes:
    """Return the head of a request with the protocol's newer name, which the server understands."""
    return _rename(head, OLDER, NEWER)


def as_asked(head: bytes, request: Request) -> bytes:
    """Return the head of the server's response with the protocol name that the client requested."""
    if NEWER in request.protocols or OLDER not in request.protocols:
        return head
    return _rename(head, NEWER, OLDER)


def _rename(head: bytes, old: str, new: str) -> bytes:
    lines = head.decode("latin-1").split("\r\n")
    for index, line in enumerate(lines):
        name, colon, value = line.partition(":")
        if colon and name.strip().lower() == _PROTOCOL:
            names = dict.fromkeys(new if each.strip() == old else each.strip() for each in value.split(","))
            lines[index] = f"{name}: {', '.join(names)}"
    return "\r\n".join(lines).encode("latin-1")
