"""Answer ``python3 -m pendulum_hw_bridge`` of a Python that the package is not installed for."""

import sys

print(
    "error: pendulum_hw_bridge is not installed for this Python; run .venv/bin/python -m pendulum_hw_bridge ..., "
    "or source .venv/bin/activate first (make experiment creates .venv)",
    file=sys.stderr,
)
sys.exit(2)
