"""Default settings of the middleware."""

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
# rclpy has loaded the middleware by now. Fast DDS 3 refuses the whole profile for one renamed element.
_IS_FAST_DDS_3 = _MAPPED.is_file() and "/libfastdds.so" in _MAPPED.read_text(encoding="utf-8", errors="replace")
_LOOPBACK = Path(__file__).with_name("loopback_3.xml" if _IS_FAST_DDS_3 else "loopback.xml")
_LEAST_MEMORY = 1 << 30
"""Address space in which Fast DDS starts its threads; with less, it ends the process [bytes]."""
_PORTS_OF_DOMAIN = 250
_FIRST_PORT = 7400
_FIRST_UNICAST = 10
"""Offset of the first participant's discovery port; each participant takes two (RTPS 2.3, 9.6.1.1)."""


def set_middleware_defaults() -> None:
    """Stay on this host, and use sockets; call it before ``rclpy.init``.

    A plant that the whole subnet may command is a decision, not a default.

    Raises:
        FaultError: The profile is not installed, or this process's memory is limited too much.
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
    """Return the variables to set in an environment; those with an empty value are to be removed.

    With ``LOCALHOST`` Jazzy does not call out, but listens on every interface: a host with this one as a static peer
    gets in. Unless opened, a profile therefore binds Fast DDS to the loopback address; other middleware keeps
    ``LOCALHOST``.

    Sockets instead of Fast DDS's shared memory: a process killed while it holds some leaves it locked, and after some
    ten kills (five topics at 500 Hz) new matched subscribers got nothing. Round trips take as long.

    Raises:
        FaultError: The profile is not installed.
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
        raise FaultError(f"{_LOOPBACK} is missing; expected it where pendulum_msgs_py is installed")
    # SYSTEM_DEFAULT leaves the network to the profile; ROS_LOCALHOST_ONLY would override it.
    older = {"ROS_LOCALHOST_ONLY": "0"} if environment.get("ROS_LOCALHOST_ONLY") == "1" else {}
    return {_RANGE: "SYSTEM_DEFAULT", _PROFILES: ours[_PROFILES], **older}


def check_closed(domain: int) -> None:
    """Check that this process, unless opened, listens to this host alone and can be discovered on its ROS domain.

    Raises:
        FaultError: The middleware ignores the profile, or too many programs have joined the domain.
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
            "those beyond are not discovered: end some of them, or choose another domain (ROS_DOMAIN_ID)"
        )


def participant_number(ports: Iterable[int], domain: int) -> int:
    """Return which participant of a ROS domain has these UDP ports, from 1; 0 for none of its unicast ports."""
    offsets = [port - _FIRST_PORT - _PORTS_OF_DOMAIN * domain - _FIRST_UNICAST for port in ports]
    return max((offset // 2 + 1 for offset in offsets if offset >= 0), default=0)


def _most_participants() -> int:
    found = re.search(r"<maxInitialPeersRange>(\d+)<", _LOOPBACK.read_text(encoding="utf-8"))
    if found is None:
        raise FaultError(f"{_LOOPBACK} has no maxInitialPeersRange; expected the installed file")
    return int(found.group(1))


def _open_sockets() -> set[str]:
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            target = str(descriptor.readlink())
        except OSError:  # closed meanwhile: the folder's own
            continue
        if target.startswith("socket:["):
            found.add(target[len("socket:[") : -1])
    return found
