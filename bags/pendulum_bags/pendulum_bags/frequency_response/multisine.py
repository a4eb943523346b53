"""The multisine that measures both plants, as a run of each side."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pendulum_bags.experiments.run_spec import RunSpec

__all__ = ["FOLDER", "Multisine"]

FOLDER = "frequency_response"
"""Folder within a run folder for the recordings under the multisine."""
_HOLD_TIME = 0.01
"""Both plants hold each sample for the slower one's period: the same torque as a function of time [s]."""

_HIGHEST_OF_JOINTS = 100.0


@dataclass(frozen=True)
class Multisine:
    """Whole periods of a multisine, of which one more settles: amplitude [N m], period [s], frequencies [Hz]."""

    amplitude: float = 2.5
    signal_period: float = 4.0
    periods: int = 8
    lowest: float = 0.25
    highest: float = 47.5
    lines: int = 48

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.signal_period * (self.periods + 1) + 0.1

    def specs(self, sim: RunSpec, hw: RunSpec) -> tuple[RunSpec, RunSpec]:
        """Return both sides' runs under the multisine; a ParameterError if the simulation is too slow for it."""
        if (foreign := sim.foreign) is not None:
            foreign.check(_HOLD_TIME)
        if sim.mechanism is not None:
            return self._of_joints(sim), self._of_joints(hw)
        disturbance = {
            "kind": "multisine",
            "amplitude": self.amplitude,
            "signal_period": self.signal_period,
            "frequency": self.lowest,
            "frequency_end": self.highest,
            "lines": self.lines,
            "hold_time": _HOLD_TIME,
        }
        ours, theirs = (replace(spec, disturbance=disturbance, duration=self.duration) for spec in (sim, hw))
        return ours, theirs

    def _of_joints(self, spec: RunSpec) -> RunSpec:
        """Return a run of several joints under an LQR, and the noise amplitude: a tenth of its motor's limit."""
        disturbance = {
            "kind": "multisine",
            "joints": spec.disturbance["joints"],
            "amplitude": spec.disturbance["amplitude"],
            "signal_period": self.signal_period,
            "frequency": 1.0 / self.signal_period,
            "frequency_end": _HIGHEST_OF_JOINTS,
            "lines": self.lines,
            "hold_time": spec.period,
        }
        length = self.duration
        return replace(spec, disturbance=disturbance, duration=length, controller="lqr", controller_parameters={})
