"""HEBI's own logs as recordings: the vendor's library stays with the bridge, whose program ``convert`` reads them."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pendulum_bags.runs.bridge_programs import last_words, run_bridge_program
from pendulum_bags.runs.csv_mapping import read_csv
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError

__all__ = ["read_hebi_log"]

_TIMEOUT = 300.0


def read_hebi_log(path: Path, lab: str | Path | Mapping[str, Any] | None = None) -> Recording:
    """Read a ``.hebilog``; the input is the torque measured through the spring.

    Args:
        path: The file.
        lab: Lab file with zero, sign and tare of the joint; None for those of the actuator.

    Raises:
        DataError: It cannot be read, or the lab file is something else.
    """
    if isinstance(lab, Mapping):
        raise DataError(f"{path}: mapping is given as values; expected the lab file of a HEBI log")
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "log.csv"
        told = [] if lab is None else ["--lab", str(lab)]
        try:
            done = run_bridge_program("convert", str(path), "--out", str(table), *told, timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise DataError(f"{path} was not read within {_TIMEOUT:g} s") from None
        if done.returncode != 0:
            raise DataError(last_words(done.stderr, f"{path} cannot be read"))
        recording = read_csv(table)
    return replace(recording, meta={**recording.meta, "source": str(path), "mapping": str(lab or "")})
