"""What a run of an experiment is made of."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pendulum_bags.runs.run_folder import git_revision, versions
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram

__all__ = ["HARDWARE", "TIME_BESIDE_NOISE", "NoiseSettings", "RegulationSettings"]

HARDWARE = ("emulator", "hebi")
TIME_BESIDE_NOISE = 47.0
"""Wall time of the thesis's experiment without its noise, measured on two cores; 31 s are the ramps [s]."""


@dataclass(frozen=True)
class NoiseSettings:
    """Uniform noise on the torque.

    Attributes:
        seed: Seed; one seed is one signal.
        amplitude: Largest torque [N m].
        hold_time: Time for which a sample is held [s].
        duration: Length [s].
    """

    seed: int = 1
    amplitude: float = 2.5
    hold_time: float = 0.01
    duration: float = 5.0

    def __post_init__(self) -> None:
        """Refuse what makes no signal."""
        for name, value, unit in (
            ("noise amplitude", self.amplitude, "N m"),
            ("noise hold time", self.hold_time, "s"),
            ("noise duration", self.duration, "s"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} is {value} {unit}; expected a finite number > 0")
        if self.seed < 0:
            raise ParameterError(f"seed is {self.seed}; expected >= 0")


@dataclass(frozen=True)
class RegulationSettings:
    """Regulation of the upright pendulum under noise, on simulator and hardware, as in the thesis.

    Attributes:
        plant: Preset or file of the simulated plant; the controller is designed on it too.
        hardware: Backend of the bridge.
        effort_strategy: How the actuator turns wanted torque into PWM; it changes the plant that a controller sees.
        controller: Kind of controller.
        q: Diagonal of Q.
        r: R.
        noise: The disturbance.
        storage: Storage of the bags.
        method: Integrator of the simulator; Euler as in the thesis.
    """

    plant: str = "thesis"
    hardware: str = "emulator"
    effort_strategy: str = "direct_pwm"
    controller: str = "lqr"
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    noise: NoiseSettings = NoiseSettings()
    storage: str = "mcap"
    method: str = "euler"

    def __post_init__(self) -> None:
        """Refuse unknown plants and backends before anything is started."""
        load_plant(self.plant)
        if self.hardware not in HARDWARE:
            raise ParameterError(f"hardware is {self.hardware!r}; expected one of {', '.join(HARDWARE)}")

    def controller_program(self, namespace: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the controller of one of the plants."""
        plant = self.plant if Path(self.plant).suffix == "" else str(Path(self.plant).resolve())
        parameters: dict[str, graph.ParameterArgument] = {
            "controller": self.controller,
            "plant": plant,
            "q": [float(value) for value in self.q],
            "r": float(self.r),
        }
        return graph.controller(namespace, **{**parameters, **changes})

    def disturbance_program(self, namespace: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the disturbance on one of the plants."""
        parameters: dict[str, graph.ParameterArgument] = {
            "kind": "uniform",
            "seed": self.noise.seed,
            "amplitude": self.noise.amplitude,
            "hold_time": self.noise.hold_time,
            "duration": self.noise.duration,
        }
        return graph.disturbance(namespace, **{**parameters, **changes})

    def metadata(self, experiment: str, **more: Any) -> dict[str, Any]:
        """Return what a bag says about its run."""
        return {
            "pendulum.run": {
                "experiment": experiment,
                "strategy": self.effort_strategy,
                "seed": self.noise.seed,
                "disturbance": {"kind": "uniform", **asdict(self.noise)},
                "controller": {"kind": self.controller, "q": list(self.q), "r": self.r},
                "versions": versions(),
                "git_revision": git_revision(),
                **more,
            }
        }
