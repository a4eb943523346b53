"""What this project asks of the middleware where the user has not said otherwise."""

from __future__ import annotations

import os
import re
import resource
from collections.abc import Iterable, Mapping
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

from pendulum_msgs_py.errors import FaultError

__all__ = ["check_closed", "middleware_defaults", "participant_number", "set_middleware_defaults"]

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
_TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
_SETTINGS = (_TRANSPORTS, "FASTDDS_DEFAULT_PROFILES_FILE", _PROFILES)
_MAPPED = Path("/proc/self/maps")
# rclpy has loaded the middleware by now. Fast DDS 3 refuses the whole profile for one element that was renamed.
_IS_FAST_DDS_3 = _MAPPED.is_file() and "/libfastdds.so" in _MAPPED.read_text(encoding="utf-8", errors="replace")
_LOOPBACK = Path(__file__).with_name("loopback_3.xml" if _IS_FAST_DDS_3 else "loopback.xml")
_LEAST_MEMORY = 1 << 30
"""Address space in which Fast DDS starts its threads; with less, it ends the process in ways of its own [bytes]."""
_PORTS_OF_DOMAIN = 250
_FIRST_PORT = 7400
_FIRST_UNICAST = 10
"""Offset of the port on which the first participant of a domain hears of others; each takes two (RTPS 2.3, 9.6.1.1)."""


def set_middleware_defaults() -> None:
    """Stay on this host, and pass messages through sockets; to be called before ``rclpy.init``.

    A plant that the whole subnet may command is a decision, not a default.

    Raises:
        FaultError: The profile is not where it was installed, or the memory of this process is limited too much.
    """
    _require_memory()
    for name, value in middleware_defaults(os.environ, get_rmw_implementation_identifier()).items():
        if value:
            os.environ[name] = value
        else:
            os.environ.pop(name, None)


def _require_memory() -> None:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _LEAST_MEMORY:
        raise FaultError(
            f"the memory of this process is limited to {limit >> 20} MB (ulimit -v); expected at least "
            f"{_LEAST_MEMORY >> 20} MB, which the middleware reserves for its threads"
        )


def middleware_defaults(environment: Mapping[str, str], middleware: str) -> dict[str, str]:
    """Return the variables to set in an environment, and with an empty value those to take out of it.

    The range ``LOCALHOST`` keeps a program of Jazzy from calling out, but its sockets listen on every interface:
    whoever names this host as a static peer is let in. Where nothing was opened, a profile binds Fast DDS to the
    loopback address; other middleware is left with ``LOCALHOST``.

    Sockets, because Fast DDS passes messages between processes through shared memory otherwise, and a process that is
    killed while it holds some leaves it locked: with a publisher of five topics at 500 Hz, after some ten kills new
    subscribers, matched as they were, got nothing any more. The kernel closes the sockets of the dead, and round trips
    take as long.

    Args:
        environment: What the user has set, or a program of ours that starts others.
        middleware: Identifier of the RMW implementation.

    Raises:
        FaultError: The profile is not where it was installed.
    """
    asked = environment.get(_RANGE) or "LOCALHOST"
    ours = {_PROFILES: str(_LOOPBACK), _TRANSPORTS: "UDPv4"}
    if asked == "SYSTEM_DEFAULT" and environment.get(_PROFILES) == ours[_PROFILES]:
        asked = "LOCALHOST"
    own_settings = [name for name in _SETTINGS if environment.get(name) not in {None, "", ours.get(name)}]
    if not middleware.startswith("rmw_fastrtps") or own_settings:
        return {_RANGE: asked}
    if asked != "LOCALHOST" or environment.get("ROS_STATIC_PEERS"):
        return {_RANGE: asked, _TRANSPORTS: ours[_TRANSPORTS], _PROFILES: ""}
    if not _LOOPBACK.is_file():
        # Without it Fast DDS would listen to the whole subnet.
        raise FaultError(f"{_LOOPBACK} is missing; expected it where pendulum_msgs_py is installed")
    # SYSTEM_DEFAULT leaves the network to the profile; the older variable of ROS would overrule it.
    older = {"ROS_LOCALHOST_ONLY": "0"} if environment.get("ROS_LOCALHOST_ONLY") == "1" else {}
    return {_RANGE: "SYSTEM_DEFAULT", _PROFILES: ours[_PROFILES], **older}


def check_closed(domain: int) -> None:
    """Check that this process listens to this host alone, where nobody has opened it, and can be found there.

    Args:
        domain: ROS domain that the process has joined.

    Raises:
        FaultError: The middleware has taken no notice of the profile, or more programs have joined the domain than
            find each other.
    """
    sockets = Path("/proc/self/net/udp")
    if os.environ.get(_PROFILES) != str(_LOOPBACK) or not sockets.is_file():
        return
    ports = range(_FIRST_PORT + _PORTS_OF_DOMAIN * domain, _FIRST_PORT + _PORTS_OF_DOMAIN * (domain + 1))
    own = _open_sockets()
    joined = []
    for line in sockets.read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        address, port = fields[1].split(":")
        if int(port, 16) not in ports or fields[9] not in own:
            continue
        joined.append(int(port, 16))
        if not address.endswith("7F"):
            raise FaultError(
                f"the middleware listens on UDP port {int(port, 16)} of every network; expected the loopback address "
                f"alone, as {_LOOPBACK} says (open it with {_RANGE}=SUBNET, if that is meant)"
            )

    number, most = participant_number(joined, domain), _most_participants()
    if number > most:
        raise FaultError(
            f"this program is number {number} of ROS domain {domain} on this machine; expected at most {most}, since "
            "those beyond find nobody: end some of them, or choose another domain (ROS_DOMAIN_ID)"
        )


def participant_number(ports: Iterable[int], domain: int) -> int:
    """Return which participant of a domain has these UDP ports, counted from 1; 0 for none of its unicast ports.

    Args:
        ports: Ports that a process listens on.
        domain: ROS domain.
    """
    offsets = [port - _FIRST_PORT - _PORTS_OF_DOMAIN * domain - _FIRST_UNICAST for port in ports]
    return max((offset // 2 + 1 for offset in offsets if offset >= 0), default=0)


def _most_participants() -> int:
    found = re.search(r"<maxInitialPeersRange>(\d+)<", _LOOPBACK.read_text(encoding="utf-8"))
    if found is None:
        raise FaultError(f"{_LOOPBACK} says nothing of maxInitialPeersRange; expected it as it was installed")
    return int(found.group(1))


def _open_sockets() -> set[str]:
    """Return the numbers of the sockets of this process, as the kernel's tables tell them."""
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            target = str(descriptor.readlink())
        except OSError:  # closed meanwhile: the folder's own
            continue
        if target.startswith("socket:["):
            found.add(target[len("socket:[") : -1])
    return found
