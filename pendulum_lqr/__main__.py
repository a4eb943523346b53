"""Answer ``python3 -m pendulum_lqr`` of a Python that the package is not installed for."""

import sys

print(
    "error: pendulum_lqr is not installed for this Python; run .venv/bin/python -m pendulum_lqr ..., "
    "or source .venv/bin/activate first (make experiment creates .venv)",
    file=sys.stderr,
)
sys.exit(2)
