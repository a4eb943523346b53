"""``simulator``: run the simulated pendulum, with the interface that the bridge has too."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract.plant_specs import (
    COMPILED,
    LIMIT_SPECS,
    LOCKSTEP_EPOCH_NS,
    LOOP_SPECS,
    in_units_of,
    limits_from_parameters,
)
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode
from pendulum_msgs_py.contract.timing import LoopStatistics, SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.loops.machine_code import NoMachineCodeError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, describe_plants
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run
from pendulum_msgs_py.programs.executables import report_error
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.compiled_periods import CompiledPeriods
from pendulum_msgs_py.ros.convert import sample_from_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.plant_loop import LockstepLoop, RealtimeLoop
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_sim.foreign.guarded_plant import PaceWatch, StallWatch
from pendulum_sim.simulator.engines import OWN, Engine
from pendulum_sim.simulator.loop_plant import loop_plant
from pendulum_sim.stepping.plants import random_start
from pendulum_sim.stepping.sensors import SENSOR_SPECS, Sensors
from pendulum_sim.stepping.servo import PositionServo

__all__ = ["SPECS", "SimulatorNode", "main", "run_engine"]

_SENSOR_PREFIX = "sensor."
_LONGEST_COMPILED = 0.005
"""Longest period that is compiled, as a stop waits for it [s]."""
_LEAST_PERIODS = 2.0
"""Shortest command timeout in periods."""

_SHARED_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        "start", "given", "", "Where the pendulum starts, and restarts on reset.",
        choices=("given", "bottom", "top", "random"),
    ),
    ParameterSpec(
        "initial_position", [0.0], "rad or m",
        "Where each joint is at a given start; 0 hangs down, pi is upright; one value stands for all.",
    ),
    ParameterSpec("initial_velocity", [0.0], "rad/s or m/s", "How fast each joint is at a given start."),
    ParameterSpec("initial_theta", 0.0, "rad", "Former name of initial_position, for one joint."),
    ParameterSpec("initial_theta_dot", 0.0, "rad/s", "Former name of initial_velocity, for one joint."),
    ParameterSpec("seed", 0, "-", "Seed of random starts and of the sensors.", minimum=0, read_only=True),
    ParameterSpec("armed_at_start", True, "", "Arm at the start; nothing real moves here.", read_only=True),
    ParameterSpec("paused", False, "", "Start paused, until ~/pause or ~/step.", read_only=True),
    *LOOP_SPECS,
    COMPILED,
    *LIMIT_SPECS,
    *(replace(spec, name=_SENSOR_PREFIX + spec.name, read_only=True) for spec in SENSOR_SPECS),
)  # fmt: skip

SPECS: tuple[ParameterSpec, ...] = (*OWN.specs, *_SHARED_SPECS)


class SimulatorNode(PollingNode):
    """A simulated pendulum as a plant; the node has the name of its role with every engine."""

    def __init__(self, stop: Callable[[], None], engine: Engine = OWN) -> None:
        super().__init__("simulator", enable_logger_service=True)
        self._settings = NodeParameters(self, self._specs(engine), self._given_start)
        values = self._settings.values
        self._simulation = engine.make(values)
        # Before the first reset, which undoes its steps.
        self._checked = None if self._simulation.check is None else self._simulation.check()
        self._plant = self._simulation.plant
        self._coordinates = self._plant.parameters.coordinates
        parameters = self._plant.parameters
        self._dt = self._plant.dt
        period_ns = round(self._dt * NANOSECONDS)
        self._plant_description = describe_plants([] if self._simulation.sealed else [parameters])
        self._servo = PositionServo(parameters, self._dt) if parameters.is_pendulum else None
        self._failure = ""
        starts, sensor_noise = np.random.default_rng(values["seed"]).spawn(2)
        self._starts = starts
        self._sensors = Sensors(
            sensor_noise, **{spec.name: values[_SENSOR_PREFIX + spec.name] for spec in SENSOR_SPECS}
        )
        self._statistics = LoopStatistics(period_ns)
        # With a long period from a file's timestep, commands would expire before they are applied.
        least = _LEAST_PERIODS * self._dt
        limits = limits_from_parameters(
            values,
            parameters.command_limits,
            push=parameters.effort_limits,
            coordinates=self._coordinates,
            lockstep=values["clock"] == "lockstep",
            least_command_timeout=least,
        )
        self._supervisor = SharedSupervisor(
            limits, self._preflight, coordinates=self._coordinates, follows=self._servo is not None
        )
        self._no_effort = (0.0,) * len(self._coordinates.driven)
        self._lockstep = values["clock"] == "lockstep"
        self._wall = wall = SteadyWallClock()
        self._pace = PaceWatch(self._dt) if engine.foreign and not self._lockstep else None
        self._stall: AbstractContextManager[object] = nullcontext()
        if engine.foreign:
            self._stall = StallWatch(values["step_timeout"], self._end_stalled)
        self._state = self._plant.state
        self._loop: Any = None
        self._interface = PlantInterface(
            self,
            self._supervisor,
            (lambda: self._loop.now_ns if self._loop else LOCKSTEP_EPOCH_NS) if self._lockstep else wall,
            polled=True,
            statistics=None if self._lockstep else self._statistics,
            more_diagnostics=self._diagnostics,
            on_command=self._on_command if self._lockstep else None,
            motor_efforts=parameters.voltage_efforts if self._coordinates.volts else None,
        )
        self._interface.hardware_id = f"simulated {parameters.name}"
        if self._lockstep:
            self._loop = LockstepLoop(
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
        self._loop.compiled, self._loop_text = self._compile(period_ns)
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
            f"plant {parameters.name!r}, {self._simulation.method}, {1.0 / self._dt:g} Hz, {values['clock']}"
        )
        for remark in self._simulation.remarks:
            self.get_logger().info(remark)
        if self._checked is not None:
            line = f"simulation {self._simulation.name} {self._checked}"
            (self.get_logger().info if self._checked.agrees else self.get_logger().warning)(line)

    def close(self) -> None:
        """Stop the plant and publish a last zero torque, for recordings."""
        self._interface.safe_stop("simulator ends")
        self._interface.publish_applied(self._stamp_ns, self._no_effort)
        self._interface.close()

    def _compile(self, period_ns: int) -> tuple[CompiledPeriods | None, str]:
        """Return the compiled loop of nominal periods, or None, and its text for diagnostics."""
        try:
            if not self._settings["compiled"]:
                raise NoMachineCodeError("compiled is false")
            if not self._lockstep and self._dt > _LONGEST_COMPILED:
                raise NoMachineCodeError(f"a period is longer than {_LONGEST_COMPILED:g} s")
            if not self._sensors.ideal:
                raise NoMachineCodeError("sensors are not ideal")
            periods = CompiledPeriods(
                self._interface,
                loop_plant(self._simulation.plant),
                period_ns,
                clock=None if self._lockstep else self._wall,
                clock_publisher=self._loop.clock_publisher if self._lockstep else None,
                done=self._note_periods,
            )
        except NoMachineCodeError as error:
            return None, f"interpreted: {error}"
        return periods, "compiled"

    def _note_periods(self, stamp_ns: int) -> None:
        self._state, self._stamp_ns = self._plant.state, stamp_ns

    # --- the loop ------------------------------------------------------------------------------------------

    def run_due(self) -> float:
        """Run due periods; return the time until the next call [s]."""
        due: float = self._loop.run_due()
        return due

    def _advance(self, drive: Drive, stamp_ns: int) -> tuple[JointSample | None, Vector]:
        if self._failure:
            return None, self._no_effort
        effort = drive.effort
        if drive.kind is DriveKind.POSITION:
            assert self._servo is not None
            # The servo compensates gravity: the handover's feed-forward would count it twice.
            (theta,), (theta_dot,), (limit,) = (
                self._state.position,
                self._state.velocity,
                self._supervisor.limits.effort,
            )
            (position,), (velocity,) = drive.position, drive.velocity
            effort = (self._servo.effort(theta, theta_dot, position, velocity, limit=limit),)
        try:
            problem = self._step(effort, drive.push, stamp_ns)
        except FaultError as error:
            problem = str(error)
        if problem:
            self._fail(problem)
            return None, self._no_effort
        self._stamp_ns = stamp_ns
        return self._measure(), effort

    def _step(self, effort: Vector, push: Vector, stamp_ns: int) -> str:
        pace = self._pace
        if pace is None:
            with self._stall:
                self._state = self._plant.step(effort, push)
            return ""
        begun = time.monotonic()
        with self._stall:
            self._state = self._plant.step(effort, push)
        return pace.problem(time.monotonic() - begun, (self._wall() - stamp_ns) / NANOSECONDS)

    def _fail(self, reason: str) -> None:
        self._failure = reason
        self._loop.halted = True
        self._supervisor.fault(reason, self._interface.clock())
        self._interface.decide()

    def _preflight(self) -> str:
        return f"{self._failure}; reset it first" if self._failure else ""

    def _end_stalled(self) -> None:
        """End the process from outside of the stalled step, which blocks the node's only thread."""
        name, timeout = self._simulation.name, self._settings.values["step_timeout"]
        reason = f"a step of simulation {name} did not come back within {timeout:g} s"
        self._supervisor.fault(reason, self._interface.clock())
        self._interface.publish_diagnostics()
        self._interface.publish_applied(self._stamp_ns, self._no_effort)
        report_error(FaultError(reason))
        os._exit(1)

    def _measure(self) -> JointSample | None:
        _, position, velocity, effort = self._state
        return self._sensors.measure(self._stamp_ns, position, velocity, effort)

    def _on_command(self, kind: Input, command: JointCommand) -> None:
        self._loop.answered(kind, command)

    # --- services and parameters ---------------------------------------------------------------------------

    def _restart(self, position: Vector, velocity: Vector) -> None:
        with self._stall:
            self._state = self._plant.reset(position, velocity)
        # The first measurement is exact: arming and trajectories need one, and a sensor may drop it.
        self._interface.sample = self._measure() or JointSample(self._stamp_ns, *self._state[1:])

    def _specs(self, engine: Engine) -> tuple[ParameterSpec, ...]:
        """Return the parameters; limits have the units of the given plant's joints."""
        specs, given = (*engine.specs, *_SHARED_SPECS), self._parameter_overrides.get("plant")
        plant = "" if given is None or engine is not OWN else str(given.value)
        return in_units_of(specs, load_plant_to_run(plant)[0].coordinates) if plant else specs

    def _start_state(self, values: Mapping[str, Any]) -> tuple[Vector, Vector]:
        start, coordinates = values["start"], self._coordinates
        still = (0.0,) * len(coordinates.joints)
        if start == "bottom":
            return still, still
        if start == "top":
            return coordinates.goal, still
        if start == "random":
            return random_start(self._plant, self._starts)
        return self._given_start(values)

    def _given_start(self, values: Mapping[str, Any]) -> tuple[Vector, Vector]:
        """Return position and velocity of a given start, also by the former names of one joint.

        Raises:
            ParameterError: A number is not finite, their count is wrong, or both names are used.
        """
        for name in ("initial_position", "initial_velocity", "initial_theta", "initial_theta_dot"):
            if not np.isfinite(values[name]).all():
                raise ParameterError(f"{name} is {values[name]}; expected finite numbers")
        named = ("initial_position", "initial_velocity")
        position, velocity = (self._coordinates.for_each(name, values[name]) for name in named)
        former = (values["initial_theta"],), (values["initial_theta_dot"],)
        if former == ((0.0,), (0.0,)):
            return position, velocity
        if len(position) > 1 or any(position + velocity):
            raise ParameterError(
                f"initial_theta is {former[0][0]} rad, initial_theta_dot {former[1][0]} rad/s: former names, for one "
                f"joint alone; expected initial_position and initial_velocity, of {self._coordinates.with_units}"
            )
        return former

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = self._reset(*self._start_state(self._settings.values))
        response.success = not refusal
        response.message = refusal or self._where()
        return response

    def _on_set_state(self, message: JointState) -> None:
        names = self._coordinates.names
        sample = sample_from_message(message, names)
        if sample is None or not sample.is_finite():
            refusal = f"expected a finite position and velocity of {', '.join(names)}"
        else:
            refusal = self._reset(sample.position, sample.velocity)
        if refusal:
            self.get_logger().error(f"set_state refused: {refusal}")

    def _reset(self, position: Vector, velocity: Vector) -> str:
        if self._supervisor.mode is Mode.POSITION:
            return "a trajectory is being followed; disarm first"
        try:
            self._restart(position, velocity)
        except (FaultError, ParameterError) as error:
            return str(error)
        self._failure = ""
        self._loop.halted = False
        for gate in self._supervisor.gates.values():
            gate.reset()
        if len(position) == 1:
            self._interface.publish_event("reset", theta=position[0], theta_dot=velocity[0])
        else:
            names = self._coordinates.names
            details = {
                "position": dict(zip(names, position, strict=True)),
                "velocity": dict(zip(names, velocity, strict=True)),
            }
            self._interface.publish_event("reset", **details)
        return ""

    def _where(self, *, speed: bool = True) -> str:
        state = self._state
        if len(state.position) == 1:
            text = f"theta {state.position[0]:.6f} rad"
            return f"{text}, theta_dot {state.velocity[0]:.6f} rad/s" if speed else text
        joints = self._coordinates.joints
        texts = [f"{joint.name} {q:.6f} {joint.unit}" for joint, q in zip(joints, state.position, strict=True)]
        if speed:
            texts += [
                f"{joint.name}_dot {v:.6f} {joint.velocity_unit}"
                for joint, v in zip(joints, state.velocity, strict=True)
            ]
        return ", ".join(texts)

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
        response.success, response.message = True, self._where(speed=False)
        return response

    def _diagnostics(self) -> Mapping[str, object]:
        values = self._settings.values
        figures: dict[str, object] = {
            "plant": self._simulation.name,
            PLANT_PARAMETERS: self._plant_description,
            "method": self._simulation.method,
            "clock": values["clock"],
            "loop": self._loop_text,
            "paused": self._loop.paused,
            "samples_dropped": self._sensors.dropped,
        }
        if self._loop.compiled is not None:
            figures["periods_compiled"] = self._loop.compiled.periods
        if self._lockstep:
            figures.update(self._loop.diagnostics())
        return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the simulator."""
    return run_engine(OWN, argv)


def run_engine(engine: Engine, argv: Sequence[str] | None = None) -> int:
    """Run the node with an engine; return the exit code."""
    return run_node(
        lambda stop: SimulatorNode(stop, engine),
        argv,
        program=f"pendulum_sim {engine.program}",
        description=engine.description,
        specs=(*engine.specs, *_SHARED_SPECS),
        example=engine.example,
    )
