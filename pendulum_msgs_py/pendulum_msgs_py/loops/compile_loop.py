"""The compiler's process: ``python -m pendulum_msgs_py.loops.compile_loop FILE MODULE:BUILDER [CHOICE ...]``."""

from __future__ import annotations

import sys
from pathlib import Path

from pendulum_msgs_py.loops.machine_code import compile_loop

if __name__ == "__main__":
    compile_loop(Path(sys.argv[1]), *sys.argv[2:])
