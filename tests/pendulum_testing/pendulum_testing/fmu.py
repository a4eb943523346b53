"""A pendulum as an FMU of FMI 2 or 3, built from Python; it refuses a communication point that is off its grid."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

__all__ = ["build_fmu"]

UNIT = """
import math
from pythonfmu{three} import Fmi{n}Causality as Causality, Fmi{n}Slave, Fmi{n}Variability as Variability, {real}

class Arm{n}(Fmi{n}Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time = 0.0
        self.tau, self.theta, self.theta_dot, self.theta_0, self.theta_dot_0, self.damping = [0.0] * 5 + [0.3]
        self.points = []
        for name, causality in (("tau", "input"), ("theta", "output"), ("theta_dot", "output")):
            self.register_variable({real}(name, causality=getattr(Causality, causality)))
        for name in ("theta_0", "theta_dot_0", "damping"):
            self.register_variable({real}(name, causality=Causality.parameter, variability=Variability.tunable))
        {time}

    def exit_initialization_mode(self):
        self.theta, self.theta_dot = self.theta_0, self.theta_dot_0

    def do_step(self, now, step):
        # A point is the last one and a step, to a nanosecond, or the importer truncates.
        self.points.append(now)
        if abs(now * 1e9 - round(now * 1e9)) > 1e-3 or abs(now - (len(self.points) - 1) * step) > 1e-9:
            return False
        for _ in range(4):
            a = (self.tau - self.damping * self.theta_dot - 2.0 * math.sin(self.theta)) / 0.125
            self.theta_dot += 0.25 * step * a
            self.theta += 0.25 * step * self.theta_dot
        return self.theta < 50.0
"""
TIME = "self.register_variable(Float64('time', causality=Causality.independent, variability=Variability.continuous))"


def build_fmu(folder: Path, version: int) -> Path:
    """Return an FMU with inertia 0.125 kg m^2, gravity 2 N m and the parameter ``damping``, 0.3 N m s/rad."""
    three, real, time = ("3", "Float64", TIME) if version == 3 else ("", "Real", "")
    (folder / f"arm{version}.py").write_text(UNIT.format(n=version, three=three, real=real, time=time))
    command = [sys.executable, "-m", f"pythonfmu{three}", "build", "-f", f"arm{version}.py", "-d", "."]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / f"Arm{version}.fmu"
