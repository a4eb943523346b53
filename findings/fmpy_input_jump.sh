#!/usr/bin/env bash
# Expected: with an output_interval of 2 ms a controller FMU is called every 2 ms; a jump of its input shows in the
# next row.
# Happens: a jump inside an interval splits the step: one call more, two shorter steps, and a row at the jump's time.
# In that row the input used still has its old value: a controller that takes its step as constant integrates wrongly.
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

import numpy as np
from fmpy import simulate_fmu
from pythonfmu.builder import FmuBuilder

Path("echo.py").write_text("""
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Echo(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u = self.used = self.step = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        for name in ("used", "step"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.used, self.step = self.u, step_size
        return True
""")
FmuBuilder.build_FMU("echo.py", dest=".")
jump = np.array([(0.0, 0.0), (0.0055, 0.0), (0.0055, 1.0), (0.01, 1.0)], dtype=[("time", float), ("u", float)])
rows = simulate_fmu("Echo.fmu", stop_time=0.01, output_interval=0.002, input=jump, output=["used", "step"])
for row in rows:
    print("time", round(float(row["time"]), 4), "input used", float(row["used"]), "step", round(float(row["step"]), 4))
assert np.allclose(rows["time"], [0, 0.002, 0.004, 0.0055, 0.006, 0.008, 0.01])
assert np.allclose(rows["step"][1:], [0.002, 0.002, 0.0015, 0.0005, 0.002, 0.002])
PY
