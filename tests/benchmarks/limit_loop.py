"""The limit of the node benchmark: plant and answerers in C on ``rcl``, compiled on the spot, nothing else in them.

Run as ``python -m tests.benchmarks.limit_loop LIBRARY plant RATE_HZ STATES ANSWERERS`` (a rate of 0 is lockstep) and
``... LIBRARY answerer INDEX``. The plant prints ``running``, and at its end a line of JSON: the round trip of each
state [ns], 0 for one that was not answered in time, and how many deadlines were missed.
"""

from __future__ import annotations

import ctypes
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import rclpy

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.ros.middleware import set_middleware_defaults

__all__ = ["build_limit", "main"]

_SOURCE = Path(__file__).with_suffix(".c")
_LIBRARIES = ("librcutils", "librosidl_runtime_c", "librmw", "librcl", "libsensor_msgs__rosidl_typesupport_c")


def build_limit(folder: Path) -> Path:
    """Compile the loop against the headers that came with rclpy; return the library.

    Args:
        folder: Where to put it.

    Raises:
        FileNotFoundError: There is no compiler, or rclpy came without headers.
        RuntimeError: The compiler refuses.
    """
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise FileNotFoundError("no C compiler is installed; expected cc, gcc or clang")
    headers = sorted(path for path in (_prefix() / "include").glob("*") if path.is_dir())
    if not any((path / "rcl" / "rcl.h").is_file() for path in headers):
        raise FileNotFoundError(f"rcl/rcl.h is not below {_prefix() / 'include'}; expected it beside rclpy")
    library = folder / "limit_loop.so"
    command = [
        compiler,
        "-O2",
        "-shared",
        "-fPIC",
        str(_SOURCE),
        "-o",
        str(library),
        *(f"-I{path}" for path in headers),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{compiler} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return library


def main() -> None:
    """Run one process of the loop: with the library, the role and the role's arguments from the command line."""
    library, role, *arguments = sys.argv[1:]
    # Python's handler would only set a flag that nobody in C looks at.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    set_middleware_defaults()
    for name in _LIBRARIES:
        ctypes.CDLL(str(_prefix() / "lib" / f"{name}.so"), ctypes.RTLD_GLOBAL)
    loop = ctypes.CDLL(library)
    if role == "answerer":
        loop.run_answerer(int(arguments[0]))
        sys.exit("the loop in C ended")
    rate, states, answerers = float(arguments[0]), int(arguments[1]), int(arguments[2])
    data = encode_joint_state(0, position=1.0, velocity=2.0, effort=3.0)
    round_trips = np.zeros(states, dtype=np.int64)
    loop.run_plant.restype = ctypes.c_long
    print("running", flush=True)
    missed = loop.run_plant(
        ctypes.c_double(rate),
        ctypes.c_long(states),
        answerers,
        data,
        ctypes.c_long(len(data)),
        round_trips.ctypes.data_as(ctypes.POINTER(ctypes.c_long)),
    )
    if missed < 0:
        sys.exit("the loop in C ended with an error")
    print(json.dumps({"missed": missed, "round_trips_ns": round_trips.tolist()}), flush=True)


def _prefix() -> Path:
    return Path(rclpy.__file__).parents[4]


if __name__ == "__main__":
    main()
