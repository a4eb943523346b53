"""A lockstep run of the simulator without nodes: the same parts in one process, bit for bit the same numbers."""

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
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, load_plant
from pendulum_sim.stepping.plants import JointPlant, make_plant
from pendulum_sim.stepping.sensors import Sensors

__all__ = ["RunArrays", "simulate", "simulate_plant"]


@dataclass(frozen=True)
class RunArrays:
    """The content of the run's bag: n + 1 rows for n steps, but n of ``applied``.

    A row is a number for a plant of one joint, else a value per joint, or for ``command`` and ``applied`` per driven
    joint.

    Attributes:
        stamp_ns: Of the states [ns].
        position: [rad or m].
        velocity: [rad/s or m/s].
        effort: Measured efforts [N m or N].
        command: The controller's commands; NaN without one [N m or N].
        disturbance: On the disturbed joint [N m or N].
        applied: Efforts that acted from each state on [N m or N].
    """

    stamp_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array
    command: Array
    disturbance: Array
    applied: Array


def simulate(spec: RunSpec) -> RunArrays:
    """Run simulator, controller and disturbance in this process; a ParameterError for unsupported runs."""
    if spec.has_bridge or spec.plant_parameters:
        raise ParameterError("a run in one process is of the plain simulator; others run as nodes")
    if (foreign := spec.foreign) is not None:
        return _simulate(spec, foreign.open(), Sensors())
    if (mechanism := spec.mechanism) is not None:
        return _simulate(spec, make_plant(mechanism, _whole(spec.period)), Sensors())
    return simulate_plant(spec, load_plant(spec.plant))


def simulate_plant(spec: RunSpec, parameters: PlantParameters, sensors: Sensors | None = None) -> RunArrays:
    """Run another plant than the run's, with any sensors that drop no samples (None for the truth)."""
    plant = make_plant(parameters, _whole(spec.period), method=spec.method)
    return _simulate(spec, plant, sensors or Sensors())


def _whole(period: float) -> float:
    return round(NANOSECONDS * period) / NANOSECONDS


def _simulate(spec: RunSpec, plant: JointPlant, sensors: Sensors) -> RunArrays:
    period_ns = round(NANOSECONDS * spec.period)
    coordinates, is_one = plant.parameters.coordinates, plant.parameters.is_pendulum
    limits: dict[str, Any] = validate(LIMIT_SPECS, BEGINS_ANYWHERE if is_one else {})
    supervisor = PlantSupervisor(
        limits_from_parameters(limits, plant.parameters.command_limits, coordinates=coordinates, lockstep=True),
        coordinates=coordinates,
    )
    design = load_mechanism(spec.design_plant)
    controller = ControlLoop(
        make_controller(spec.controller, design, spec.period, spec.law(design)), float("inf"), simulated_time=True
    )
    chosen = spec.disturbance_parameters()
    disturbed = tuple(chosen.pop("joints", coordinates.driven_names[:1]))
    length = chosen.pop("duration", 0.0)
    chosen.pop("volts", None)
    signal = make_disturbance(validate(DISTURBANCE_SPECS, chosen))
    disturbance = DisturbanceLoop(signal, length, simulated_time=True)
    disturbance.start()

    count = spec.steps
    stamps = LOCKSTEP_EPOCH_NS + period_ns * np.arange(count + 1, dtype=np.int64)
    joints, driven = len(coordinates.joints), len(coordinates.driven)
    states, commands = np.full((count + 1, 3, joints), np.nan), np.full((count + 1, 2, driven), np.nan)
    pushes = np.zeros(count + 1)
    start = (spec.theta,) if is_one else spec.start_position(plant.parameters)
    _, *state = plant.reset(start, (0.0,) * joints)
    sample = sensors.measure(LOCKSTEP_EPOCH_NS, *state)
    if sample is None:
        raise ParameterError("sensors drop samples; expected a drop_rate of 0 in a run in one process")
    supervisor.arm(LOCKSTEP_EPOCH_NS, sample)
    for index in range(count + 1):
        now_ns = sample.stamp_ns
        answer = controller.answer(sample, now_ns)
        push = disturbance.answer(now_ns)
        torque = push.torque if push is not None else 0.0
        if answer is not None:
            command = JointCommand(now_ns, answer, "controller", coordinates.driven_names)
            supervisor.offer(Input.EFFORT_COMMAND, command, now_ns)
        supervisor.offer(Input.DISTURBANCE, JointCommand(now_ns, (torque,), "disturbance", disturbed), now_ns)
        states[index] = sample.position, sample.velocity, sample.effort
        pushes[index] = torque
        if answer is not None:
            commands[index, 0] = answer
        if index == count:
            break
        drive = supervisor.decide(now_ns, sample)
        _, *state = plant.step(drive.effort, drive.push)
        supervisor.report_applied(drive.effort)
        commands[index, 1] = drive.effort
        measured = sensors.measure(int(stamps[index + 1]), *state)
        if measured is None:
            raise ParameterError("sensors drop samples; expected a drop_rate of 0 in a run in one process")
        sample = measured
    columns = [states[:, 0], states[:, 1], states[:, 2], commands[:, 0], commands[:-1, 1]]
    position, velocity, effort, command_rows, applied = (one[:, 0] for one in columns) if is_one else columns
    return RunArrays(stamps, position, velocity, effort, command_rows, pushes, applied)
