"""A ROS domain of its own for each experiment on a machine, so that two of them never share a graph."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pendulum_msgs_py.errors import FaultError, ParameterError

__all__ = ["MAX_DOMAIN", "check_domain", "is_unused", "reserve_domain"]

MAX_DOMAIN = 100
"""Beyond 101 the ports of a domain overlap with Linux's ephemeral ports."""


@contextlib.contextmanager
def reserve_domain(requested: int | None = None) -> Iterator[int]:
    """Reserve the ROS domain ``requested``, or ``ROS_DOMAIN_ID``, or the first free one, for the context.

    A ParameterError for an invalid domain, a FaultError if another experiment uses it or all are in use.
    """
    requested = check_domain(requested)
    folder = Path(tempfile.gettempdir(), f"pendulum_domains_{os.getuid()}")
    folder.mkdir(exist_ok=True)
    if requested is not None:
        # A second lock: the holder of a domain may run one experiment at a time.
        with (folder / f"{requested}.experiment.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise FaultError(
                    f"ROS domain {requested} is in use by another experiment on this machine; "
                    "choose another with --domain or ROS_DOMAIN_ID, or none for the first free one"
                ) from None
            yield requested
        return
    for step in range(MAX_DOMAIN):
        domain = 1 + (os.getpid() + step) % MAX_DOMAIN
        with (folder / f"{domain}.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if is_unused(domain):
                yield domain
                return
    raise FaultError(f"all ROS domains from 1 to {MAX_DOMAIN} are in use on this machine")


def check_domain(requested: int | None) -> int | None:
    """Return the domain of the user or of ``ROS_DOMAIN_ID``, None for any; a ParameterError if it is invalid."""
    if requested is None and os.environ.get("ROS_DOMAIN_ID"):
        text = os.environ["ROS_DOMAIN_ID"]
        if not text.isdigit():
            raise ParameterError(f"ROS_DOMAIN_ID is {text!r}; expected an integer from 0 to {MAX_DOMAIN}")
        requested = int(text)
    if requested is not None and not 0 <= requested <= MAX_DOMAIN:
        raise ParameterError(f"ROS domain is {requested}; expected 0 to {MAX_DOMAIN}")
    return requested


def is_unused(domain: int) -> bool:
    """Return whether no DDS participant on this machine has the domain's ports (DDSI-RTPS 2.5, section 9.6.2.3)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True
