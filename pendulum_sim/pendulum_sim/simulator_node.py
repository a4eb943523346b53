"""``simulator``: the plant behind the contract that simulator and hardware share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, LOCKSTEP_EPOCH_NS, LOOP_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode, PlantSupervisor
from pendulum_msgs_py.contract.timing import LoopStatistics, SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, describe_plants
from pendulum_msgs_py.plants.plant_parameters import PRESET_NAMES
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import sample_from_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.plant_loop import LockstepLoop, RealtimeLoop
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_sim.integrators import METHODS
from pendulum_sim.plant import PlantState
from pendulum_sim.plants import make_plant
from pendulum_sim.sensors import SENSOR_SPECS, Sensors
from pendulum_sim.servo import PositionServo

__all__ = ["SPECS", "SimulatorNode", "main"]

_SENSOR_PREFIX = "sensor."

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("plant", "thesis", "", f"Preset ({PRESET_NAMES}) or path of a plant file.", read_only=True),
    ParameterSpec(
        "method",
        "auto",
        "",
        "Integrator; auto is etd4 for a rigid plant, semi_implicit for a series-elastic one.",
        choices=("auto", *METHODS),
        read_only=True,
    ),
    ParameterSpec("rate_hz", 500.0, "Hz", "Rate of states and commands.", minimum=50.0, maximum=2000.0, read_only=True),
    ParameterSpec(
        "substeps",
        0,
        "-",
        "Integration steps in a period; 0 chooses by the plant.",
        minimum=0,
        read_only=True,
    ),
    ParameterSpec(
        "start",
        "given",
        "",
        "Where the pendulum starts, and restarts on reset.",
        choices=("given", "bottom", "top", "random"),
    ),
    ParameterSpec("initial_theta", 0.0, "rad", "Angle at a given start; 0 hangs down, pi is upright."),
    ParameterSpec("initial_theta_dot", 0.0, "rad/s", "Velocity at a given start."),
    ParameterSpec("seed", 0, "-", "Seed of random starts and of the sensors.", minimum=0, read_only=True),
    ParameterSpec("armed_at_start", True, "", "Arm without being asked; nothing real moves here.", read_only=True),
    ParameterSpec("paused", False, "", "Start paused, until ~/pause or ~/step says otherwise.", read_only=True),
    *LOOP_SPECS,
    *LIMIT_SPECS,
    *(replace(spec, name=_SENSOR_PREFIX + spec.name, read_only=True) for spec in SENSOR_SPECS),
)


class SimulatorNode(PollingNode):
    """A simulated pendulum as a plant.

    Args:
        stop: Asks the runner to end the process.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("simulator", enable_logger_service=True)
        self._settings = NodeParameters(self, SPECS, self._check_start)
        values = self._settings.values
        parameters, sealed = load_plant_to_run(values["plant"])
        period_ns = round(NANOSECONDS / values["rate_hz"])
        self._dt = period_ns / NANOSECONDS
        self._told_plant = describe_plants([] if sealed else [parameters])
        self._plant = make_plant(parameters, self._dt, method=values["method"], substeps=values["substeps"] or None)
        self._servo = PositionServo(parameters, self._dt)
        starts, sensor_noise = np.random.default_rng(values["seed"]).spawn(2)
        self._starts = starts
        self._sensors = Sensors(
            sensor_noise, **{spec.name: values[_SENSOR_PREFIX + spec.name] for spec in SENSOR_SPECS}
        )
        self._statistics = LoopStatistics(period_ns)
        self._supervisor = PlantSupervisor(limits_from_parameters(values, parameters.effort_limit))
        self._lockstep = values["clock"] == "lockstep"
        wall = SteadyWallClock()
        self._state: PlantState = self._plant.state
        self._interface = PlantInterface(
            self,
            self._supervisor,
            (lambda: self._loop.now_ns) if self._lockstep else wall,
            polled=not self._lockstep,
            statistics=None if self._lockstep else self._statistics,
            more_diagnostics=self._diagnostics,
            on_command=self._on_command,
        )
        self._interface.hardware_id = f"simulated {parameters.name}"
        if self._lockstep:
            self._loop: Any = LockstepLoop(
                self._interface,
                self._advance,
                period_ns,
                [Input(name) for name in values["lockstep_inputs"]],
                subscribers=values["lockstep_subscribers"],
                duration=values["lockstep_duration"],
            )
            self._stamp_ns = LOCKSTEP_EPOCH_NS
        else:
            self._loop = RealtimeLoop(self._interface, self._advance, self._statistics, wall)
            self._stamp_ns = wall()
        self._loop.paused = values["paused"]
        self._restart(*self._start_state(values))
        if values["armed_at_start"]:
            refusal = self._supervisor.arm(self._stamp_ns, self._interface.sample)
            if refusal:
                raise ParameterError(f"armed_at_start: {refusal}")
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_subscription(JointState, "~/set_state", self._on_set_state, qos.TRAJECTORY)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.get_logger().info(
            f"plant {parameters.name!r}, {values['method']}, {values['rate_hz']:g} Hz, {values['clock']}"
        )

    def close(self) -> None:
        """Stop the plant: a last zero torque is published, so that a recording shows it."""
        self._interface.safe_stop("simulator ends")
        self._interface.publish_applied(self._stamp_ns, 0.0)

    # --- the loop ------------------------------------------------------------------------------------------

    def run_due(self) -> float:
        """Let the loop do what is due; return the time until it wants to be called again [s]."""
        due: float = self._loop.run_due()
        return due

    def _advance(self, drive: Drive, stamp_ns: int) -> tuple[JointSample | None, float]:
        effort = drive.effort
        if drive.kind is DriveKind.POSITION:
            # The servo knows the weight it carries, so the hand-over's feed-forward would count it twice.
            wanted = self._servo.effort(self._state.theta, self._state.theta_dot, drive.position, drive.velocity)
            limit = self._supervisor.limits.effort
            effort = min(limit, max(-limit, wanted))
        self._state = self._plant.step(effort, drive.push)
        # In real time this is the deadline, not the moment at which Python got there.
        self._stamp_ns = stamp_ns
        return self._measure(), effort

    def _measure(self) -> JointSample | None:
        state = self._state
        return self._sensors.measure(self._stamp_ns, state.theta, state.theta_dot, state.effort)

    def _on_command(self, kind: Input, command: JointCommand) -> None:
        if self._lockstep:
            self._loop.answered(kind, command)
        elif kind is Input.EFFORT_COMMAND and command.stamp_ns == self._stamp_ns:
            # Until the answer reached this process; that it waits there for the next deadline costs it nothing. Both
            # are system time; they differ by a fraction of a period, so a step of that clock between them is unlikely.
            self._statistics.round_trip(self._interface.arrived_ns - self._interface.published_ns)

    # --- services and parameters ---------------------------------------------------------------------------

    def _restart(self, theta: float, theta_dot: float) -> None:
        self._state = self._plant.reset(theta, theta_dot)
        state = self._state
        # The first measurement is exact: arming and trajectories need one, and a sensor may drop it.
        self._interface.sample = self._measure() or JointSample(
            self._stamp_ns, state.theta, state.theta_dot, state.effort
        )

    def _start_state(self, values: Mapping[str, Any]) -> tuple[float, float]:
        start = values["start"]
        if start == "bottom":
            return 0.0, 0.0
        if start == "top":
            return math.pi, 0.0
        if start == "random":
            return float(self._starts.uniform(-math.pi, math.pi)), float(self._starts.uniform(-1.0, 1.0))
        return values["initial_theta"], values["initial_theta_dot"]

    @staticmethod
    def _check_start(values: Mapping[str, Any]) -> None:
        for name in ("initial_theta", "initial_theta_dot"):
            if not math.isfinite(values[name]):
                raise ParameterError(f"{name} is {values[name]}; expected a finite number")

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = self._reset(*self._start_state(self._settings.values))
        state = self._state
        response.success = not refusal
        response.message = refusal or f"theta {state.theta:.6f} rad, theta_dot {state.theta_dot:.6f} rad/s"
        return response

    def _on_set_state(self, message: JointState) -> None:
        sample = sample_from_message(message)
        if sample is None or not sample.is_finite():
            refusal = f"expected a finite position and velocity of {JOINT}"
        else:
            refusal = self._reset(sample.position, sample.velocity)
        if refusal:
            self.get_logger().error(f"set_state refused: {refusal}")

    def _reset(self, theta: float, theta_dot: float) -> str:
        if self._supervisor.mode is Mode.POSITION:
            return "a trajectory is being followed; disarm first"
        self._restart(theta, theta_dot)
        for gate in self._supervisor.gates.values():
            gate.reset()
        self._interface.publish_event("reset", theta=theta, theta_dot=theta_dot)
        return ""

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._loop.paused = request.data
        response.success, response.message = True, "paused" if request.data else "running"
        self._interface.publish_event(response.message)
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._loop.paused:
            response.success, response.message = False, "not paused; call ~/pause with true first"
            return response
        self._loop.step_once()
        response.success, response.message = True, f"theta {self._state.theta:.6f} rad"
        return response

    def _diagnostics(self) -> Mapping[str, object]:
        values = self._settings.values
        figures: dict[str, object] = {
            "plant": values["plant"],
            PLANT_PARAMETERS: self._told_plant,
            "method": values["method"],
            "clock": values["clock"],
            "paused": self._loop.paused,
            "samples_dropped": self._sensors.dropped,
        }
        if self._lockstep:
            figures.update(self._loop.diagnostics())
        return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the simulator."""
    return run_node(
        SimulatorNode,
        argv,
        program="pendulum_sim simulator",
        description="Simulated pendulum behind the interface that simulator and hardware share.",
        specs=SPECS,
        example="python -m pendulum_sim simulator --ros-args -r __ns:=/sim -p plant:=x5_9",
    )
