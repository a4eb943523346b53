"""Options of a recorder, checked before anything is created."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_rosbag.storage import STORAGES
from pendulum_rosbag.storage.stamps import LOG_TIMES

__all__ = ["RecorderOptions", "read_metadata"]

ALWAYS_LEFT_OUT = frozenset({"/parameter_events", "/rosout"})


@dataclass(frozen=True, slots=True)
class RecorderOptions:
    """What to record, and how.

    Args:
        output: Folder of the bag; it must not exist.
        topics: Full topic names; empty for all (but ``/rosout`` and ``/parameter_events``).
        storage: ``mcap`` or ``sqlite3``.
        compression: ``None`` or ``zstd``.
        max_size: Largest storage file [bytes]; 0 for no limit.
        max_duration: Longest time span of a storage file [s]; 0 for no limit.
        duration: Stop after this time [s]; 0 for never.
        log_time: ``receive`` or ``header``.
        wait: Start only when the service ``~/start`` is called.
        black_box: Length of the messages held in memory and written at each fault or stop [s]; 0 records all.
    """

    output: Path
    topics: tuple[str, ...] = ()
    regex: str = ""
    exclude: str = ""
    storage: str = "mcap"
    compression: str | None = None
    max_size: int = 0
    max_duration: float = 0.0
    duration: float = 0.0
    metadata: Mapping[str, Any] = field(default_factory=dict)
    log_time: str = "receive"
    wait: bool = False
    black_box: float = 0.0

    def __post_init__(self) -> None:
        if self.log_time not in LOG_TIMES:
            raise ParameterError(f"log time is {self.log_time!r}; expected one of {', '.join(LOG_TIMES)}")
        if self.storage not in STORAGES:
            raise ParameterError(f"storage is {self.storage!r}; expected one of {', '.join(STORAGES)}")
        for name, value in (
            ("max-size", self.max_size),
            ("max-duration", self.max_duration),
            ("duration", self.duration),
            ("black-box", self.black_box),
        ):
            if not value >= 0:
                raise ParameterError(f"{name} is {value}; expected >= 0")
        if self.black_box and self.log_time != "receive":
            raise ParameterError(f"log time is {self.log_time!r} with a black box; expected 'receive'")
        for name in self.topics:
            if not name.startswith("/"):
                raise ParameterError(f"topic is {name!r}; expected its full name, such as /{name}")
        for name, pattern in (("regex", self.regex), ("exclude", self.exclude)):
            try:
                re.compile(pattern)
            except re.error as error:
                raise ParameterError(f"{name} is {pattern!r}; expected a regular expression ({error})") from None

    def wants(self, topic: str) -> bool:
        """Return whether a topic is to be recorded."""
        if self.exclude and re.search(self.exclude, topic):
            return False
        if self.topics or self.regex:
            return topic in self.topics or bool(self.regex and re.search(self.regex, topic))
        return topic not in ALWAYS_LEFT_OUT

    def unmet(self, met: Iterable[str]) -> dict[str, str]:
        """Return the requested topics that were not published, with reasons; ``met`` are those that had a publisher."""
        found = list(met)
        unmet = {name: "it had no publisher" for name in self.topics if self.wants(name) and name not in found}
        unmet |= {name: "it is left out by the pattern of exclude" for name in self.topics if not self.wants(name)}
        if self.regex and not any(re.search(self.regex, name) for name in found):
            unmet[f"topics that match {self.regex!r}"] = "they had no publisher"
        if not self.topics and not self.regex and not found:
            unmet["any topic"] = "none had a publisher"
        return unmet


def read_metadata(path: Path | None) -> dict[str, Any]:
    """Return the JSON object in a file, nothing for no file; a ParameterError if it cannot be read or is another."""
    if path is None:
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(f"metadata file {path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"metadata file {path} is no JSON: {error}") from error
    if not isinstance(content, dict):
        raise ParameterError(f"metadata file {path} holds {type(content).__name__}; expected a JSON object")
    return content
