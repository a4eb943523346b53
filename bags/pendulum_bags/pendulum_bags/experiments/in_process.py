"""A lockstep run of the simulator without nodes: the same pieces in one process, the same numbers to the last bit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.run_spec import BEGINS_ANYWHERE, RunSpec
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS, make_disturbance
from pendulum_lqr.disturbances.disturbing import DisturbanceLoop
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, LOCKSTEP_EPOCH_NS, limits_from_parameters
from pendulum_msgs_py.contract.supervisor import Input, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.stepping.plant import Plant
from pendulum_sim.stepping.plants import make_plant
from pendulum_sim.stepping.sensors import Sensors

__all__ = ["RunArrays", "simulate", "simulate_plant"]


@dataclass(frozen=True)
class RunArrays:
    """What a bag of the run would hold; every array has shape (n + 1,) for n steps, but ``applied``: (n,).

    Attributes:
        stamp_ns: Of the states [ns].
        position: [rad].
        velocity: [rad/s].
        effort: Measured torque [N m].
        command: The controller's commands; NaN where it gave none [N m].
        disturbance: [N m].
        applied: Torque that acted from each state on [N m].
    """

    stamp_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array
    command: Array
    disturbance: Array
    applied: Array


def simulate(spec: RunSpec) -> RunArrays:
    """Run the simulator, the controller and the disturbance of a run in this process.

    Raises:
        ParameterError: The run is of the emulated hardware, or its plant has parameters beyond the plain ones.
    """
    if spec.has_bridge or spec.plant_parameters:
        raise ParameterError("a run in one process is of the plain simulator; others run as nodes")
    if (foreign := spec.foreign) is not None:
        return _simulate(spec, foreign.open(), Sensors())
    return simulate_plant(spec, load_plant(spec.plant))


def simulate_plant(spec: RunSpec, parameters: PlantParameters, sensors: Sensors | None = None) -> RunArrays:
    """Run a run of the simulator on any plant and with any sensors, for what-if questions.

    Args:
        spec: The run; its ``plant`` is ignored.
        parameters: The plant.
        sensors: What the controller sees; None for the truth. They must not drop samples.
    """
    dt = round(NANOSECONDS * spec.period) / NANOSECONDS
    return _simulate(spec, make_plant(parameters, dt, method=spec.method), sensors or Sensors())


def _simulate(spec: RunSpec, plant: Plant, sensors: Sensors) -> RunArrays:
    period_ns = round(NANOSECONDS * spec.period)
    parameters = plant.parameters
    limits: dict[str, Any] = validate(LIMIT_SPECS, BEGINS_ANYWHERE)
    supervisor = PlantSupervisor(limits_from_parameters(limits, (parameters.effort_limit,), lockstep=True))
    values = {**spec.controller_parameters, "set_point": spec.set_point}
    design = load_plant(spec.design_plant)
    controller = ControlLoop(
        make_controller(spec.controller, design, spec.period, values), float("inf"), simulated_time=True
    )
    chosen = spec.disturbance_parameters()
    length = chosen.pop("duration", 0.0)
    signal = make_disturbance(validate(DISTURBANCE_SPECS, chosen))
    disturbance = DisturbanceLoop(signal, length, simulated_time=True)
    disturbance.start()

    count = spec.steps
    stamps = LOCKSTEP_EPOCH_NS + period_ns * np.arange(count + 1, dtype=np.int64)
    rows = np.full((count + 1, 6), np.nan)
    state = plant.reset(spec.theta, 0.0)
    sample = sensors.measure(LOCKSTEP_EPOCH_NS, (state.theta,), (state.theta_dot,), (state.effort,))
    if sample is None:
        raise ParameterError("sensors drop samples; expected a drop_rate of 0 in a run in one process")
    supervisor.arm(LOCKSTEP_EPOCH_NS, sample)
    for index in range(count + 1):
        now_ns = sample.stamp_ns
        answer = controller.answer(sample, now_ns)
        push = disturbance.answer(now_ns)
        torque = push.torque if push is not None else 0.0
        if answer is not None:
            supervisor.offer(Input.EFFORT_COMMAND, JointCommand(now_ns, answer, "controller"), now_ns)
        supervisor.offer(Input.DISTURBANCE, JointCommand.of_one(now_ns, torque, "disturbance"), now_ns)
        row = rows[index]
        row[:3] = sample.position[0], sample.velocity[0], sample.effort[0]
        row[3:5] = np.nan if answer is None else answer[0], torque
        if index == count:
            break
        drive = supervisor.decide(now_ns, sample)
        state = plant.step(drive.effort[0], drive.push[0])
        supervisor.report_applied(drive.effort)
        row[5] = drive.effort[0]
        measured = sensors.measure(int(stamps[index + 1]), (state.theta,), (state.theta_dot,), (state.effort,))
        if measured is None:
            raise ParameterError("sensors drop samples; expected a drop_rate of 0 in a run in one process")
        sample = measured
    return RunArrays(stamps, rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4], rows[:-1, 5])
