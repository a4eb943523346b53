"""Everything that crosses packages: contract, integration, acceptance, goldens, benchmarks and faults."""

import sys
from pathlib import Path

# What package tests share is a package of its own; here it answers in any environment, and to its former names.
_SHARED = Path(__file__).with_name("pendulum_testing")
sys.path.append(str(_SHARED))
__path__.append(str(_SHARED / "pendulum_testing"))
