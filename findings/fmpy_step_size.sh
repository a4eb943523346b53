#!/usr/bin/env bash
# Expected: step_size of simulate_fmu is the communication step, output_interval thins the rows that are returned.
# Happens: for co-simulation step_size is not used; output_interval is the communication step, and without it the
# duration decides: a controller asked for at 500 Hz runs at 500 Hz in 1 s of simulation and at 100 Hz in 8 s.
# Seen with: FMPy 0.3.32, pythonfmu 0.7.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    fmpy==0.3.32 pythonfmu==0.7.0 numpy==2.2.6
env/bin/python - <<'PY'
from pathlib import Path

from fmpy import simulate_fmu
from pythonfmu.builder import FmuBuilder

Path("counter.py").write_text("""
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Counter(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.calls = 0.0
        self.register_variable(Real("calls", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.calls += 1.0
        return True
""")
FmuBuilder.build_FMU("counter.py", dest=".")


def rate(stop, **options):
    return float(simulate_fmu("Counter.fmu", stop_time=stop, output=["calls"], **options)["calls"][-1]) / stop


asked = {stop: rate(stop, step_size=0.002) for stop in (1.0, 8.0)}
thinned = rate(8.0, step_size=0.002, output_interval=0.01)
held = rate(8.0, output_interval=0.002)
print("step_size=0.002: calls per second by duration", asked)
print("with output_interval=0.01:", thinned, " output_interval=0.002 alone:", held)
assert asked == {1.0: 500.0, 8.0: 100.0}
assert thinned == 100.0
assert held == 500.0
PY
