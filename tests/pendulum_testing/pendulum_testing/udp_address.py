"""An address for an emulator on which no middleware listens."""

from __future__ import annotations

import random
import socket

__all__ = ["free_udp_address"]

_PORTS = range(5000, 7400)
"""Below those of DDS, which takes 250 for each domain from 7400 on: domain 182 covers ports that a system hands out."""


def free_udp_address() -> str:
    """Return ``HOST:PORT`` of a free UDP port of this machine.

    Raises:
        OSError: There is none.
    """
    for port in random.sample(_PORTS, 100):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return f"127.0.0.1:{port}"
    raise OSError("no UDP port is free below those of DDS")
