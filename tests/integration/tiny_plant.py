"""A plant as small as one can be: an inertia with damping behind the shared interface, at 100 Hz.

Started as a program by ``test_plant_interface.py``. What happens on the way out is written to standard output.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import DriveKind
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node

SPECS = (
    ParameterSpec("gain", 1.0, "N m/rad", "Stiffness of the position control.", minimum=0.0),
    ParameterSpec("cycles", 3, "-", "A number of cycles.", minimum=1, maximum=9),
    ParameterSpec("offsets", [0.0, 1.0], "rad", "Two angles."),
    ParameterSpec("method", "exact", "", "How.", choices=("exact", "euler")),
    ParameterSpec("fixed", 2.0, "s", "Cannot change.", read_only=True),
    ParameterSpec("stubborn", 0.0, "s", "Time that the way out takes.", minimum=0.0),
    # Its commanders begin with what they like.
    *(replace(spec, default=0.0) if spec.name == "start_effort_limit" else spec for spec in LIMIT_SPECS),
)


class TinyPlant(PollingNode):
    """The plant."""

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("tiny_plant")
        self.parameters = NodeParameters(self, SPECS, self._prepare)
        self.clock = SteadyWallClock()
        self.supervisor = SharedSupervisor(limits_from_parameters(self.parameters.values, (5.0,), lockstep=False))
        self.interface = PlantInterface(self, self.supervisor, self.clock)
        self.position = self.velocity = 0.0
        self.stop = stop
        self.create_timer(0.01, self._step)
        print("running", flush=True)

    def close(self) -> None:
        time.sleep(self.parameters["stubborn"])
        self.interface.safe_stop("plant ends")
        self.interface.publish_applied(self.clock(), (0.0,))
        self.interface.close()
        print("closed", flush=True)

    @staticmethod
    def _prepare(values) -> None:
        from pendulum_msgs_py.errors import ParameterError

        if values["gain"] * values["cycles"] > 100.0:
            raise ParameterError(f"gain times cycles is {values['gain'] * values['cycles']}; expected at most 100")

    def _step(self) -> None:
        now = self.clock()
        self.interface.publish_state(JointSample.of_one(now, self.position, self.velocity, 0.0))
        drive = self.interface.decide(now)
        (effort,) = drive.effort
        if drive.kind is DriveKind.POSITION:
            effort += self.parameters["gain"] * (drive.position[0] - self.position)
        self.interface.publish_applied(now, (effort,))
        acceleration = effort + drive.push[0] - 2.0 * self.velocity
        self.velocity += 0.01 * acceleration
        self.position += 0.01 * self.velocity


def main(argv: Sequence[str]) -> int:
    """Run it."""
    return run_node(
        TinyPlant,
        argv,
        program="tests tiny_plant",
        description="A plant for tests.",
        specs=SPECS,
        example="python tests/integration/tiny_plant.py --ros-args -p gain:=2.0",
    )


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
