"""Play a designed excitation on a plant: torque through the disturbance node, while a controller commands zero.

The end of the replies brings the plant to zero torque by its own rules.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.domain import check_domain
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.run_spec import RunSpec, absolute_plant
from pendulum_bags.experiments.session import ANSWER_PRIORITY, START_TIMEOUT, conduct, refuse_existing, start_loop
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs import graph

__all__ = ["ExcitationPlay", "play_in_lockstep", "play_on_running_plant"]

_REST = 0.5
"""Time at rest after the last torque, so that the recording has the end of the motion [s]."""
_FIND_TIMEOUT = 30.0
_AT_REST_ANGLE = 0.1
_AT_REST_SPEED = 0.3
"""Limits of hanging at rest [rad], [rad/s]; a noisy velocity sensor shows up to 0.2 rad/s."""
_ANGLE_ROOM = 1.2
_FREE = 1e6
"""Ends of the window of a joint that turns freely [rad]."""
_SPEED_ROOM = 1.3
"""Factor on the design's limits at which the run ends: the prior plant is not the real one."""


@dataclass(frozen=True)
class ExcitationPlay:
    """What to play, and within which limits.

    Attributes:
        file: CSV with the columns time [s] and torque [N m].
        duration: Length of the excitation [s].
        period: Of the torque values [s].
        effort: Limit of the torque [N m].
        speed: Limit of the joint speed [rad/s].
        reach: Limit of the distance of each joint from hanging down [rad or m].
        prediction: The bag's metadata of the design: ``predicted`` half widths by parameter, ``kind``, ``plant``.
        coordinates: The plant's joints.
        joint: Excited joint of several; empty for the one of a pendulum.
    """

    file: Path
    duration: float
    period: float
    effort: float
    speed: float
    reach: tuple[float, ...]
    prediction: Mapping[str, Any] = field(default_factory=dict)
    coordinates: Coordinates = ONE_JOINT
    joint: str = ""

    @property
    def window(self) -> list[float]:
        """Ends of each joint in turn at which the run ends; what turns freely has far ones [rad or m]."""
        ends = [_FREE if math.isinf(reach) else _ANGLE_ROOM * reach for reach in self.reach]
        return [end for reach in ends for end in (-reach, reach)]

    def zero_file(self, folder: Path) -> Path:
        """Write the controller's playback of zero torque, and return its path."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "zero_torque.csv"
        nothing = ",0" * len(self.coordinates.driven)
        path.write_text(f"time,effort\n0{nothing}\n1{nothing}\n", encoding="utf-8")
        return path


@dataclass(frozen=True)
class _LockstepRun(RunSpec):
    sampling: float = 0.01
    prediction: Mapping[str, Any] = field(default_factory=dict)

    @property
    def period(self) -> float:
        """Time between two states [s]."""
        return self.sampling

    def metadata(self) -> dict[str, Any]:
        """Return the bag's metadata of its run, with the prediction."""
        return {**super().metadata(), "pendulum.excitation": dict(self.prediction)}


def play_in_lockstep(
    bag: Path,
    play: ExcitationPlay,
    *,
    side: str,
    plant: str,
    noise: float,
    seed: int,
    design_plant: str,
    domain: int | None = None,
) -> Path:
    """Start a simulator (``sim``) or an emulated actuator (``hw``), play on it in lockstep, and record.

    ``noise`` is the standard deviation of the simulated angle sensor [rad]; ``domain`` is None for any free one. A
    BagError if the bag exists, a FaultError if the plant faulted or a program ended.
    """
    refuse_existing(bag)
    limits: dict[str, Any] = {
        "effort_limit": float(play.effort),
        "velocity_limit": _SPEED_ROOM * play.speed,
        "position_window": play.window,
    }
    own = {"sensor.position_noise": float(noise)} if side == "sim" else {"feedback_rate": 1.0 / play.period}
    if side == "sim" and play.joint:
        # Velocities are differences of positions: exact ones would tell more than any encoder.
        own["sensor.velocity_noise"] = math.sqrt(2.0) * noise / play.period
    if side == "hw":
        limits.pop("velocity_limit")  # the actuator's own is lower than most designs'
    spec = _LockstepRun(
        side=side,
        plant=plant,
        design_plant=design_plant,
        controller="playback",
        controller_parameters={"file": str(play.zero_file(bag.parent / "logs" / bag.name).resolve())},
        disturbance={
            **({"joints": [play.joint]} if play.joint else {}),
            "kind": "from_bag",
            "file": str(play.file.resolve()),
            "duration": float(play.duration),
        },
        theta=0.0,
        duration=play.period * math.ceil((play.duration + _REST) / play.period),
        seed=seed,
        method="auto",
        plant_parameters={**limits, **own},
        sampling=play.period,
        prediction=play.prediction,
    )
    return record_run(bag, spec, domain=domain)


def play_on_running_plant(
    bag: Path, play: ExcitationPlay, namespace: str, *, arm: bool, domain: int | None = None
) -> Path:
    """Play on a running plant in ``namespace``, in real time, and record.

    ``arm`` arms it if necessary and disarms it at the end; the domain is by default ``ROS_DOMAIN_ID``, or 0.

    Raises:
        BagError: The bag exists.
        FaultError: There is no plant, it has another commander, does not hang at rest, is not armed, or left the
            limits; it is then at zero torque.
    """
    refuse_existing(bag)
    logs = bag.parent / "logs" / bag.name
    with conduct(logs, check_domain(domain) or 0) as session:
        orchestrator = session.orchestrator
        node_name = _find_plant(orchestrator, namespace)
        _refuse_others(orchestrator, namespace)
        plant = PlantClient(
            orchestrator,
            namespace,
            node_name,
            controller="zero_torque",
            disturbance="excitation",
            joints=play.coordinates.names,
        )
        orchestrator.wait_for(f"a state of {namespace}", lambda: plant.sample is not None, _FIND_TIMEOUT)
        _require_rest(orchestrator, plant, play.coordinates)
        armed = _is_armed(plant, may_arm=arm)
        run = {"experiment": "excitation", "namespace": namespace, "plant": node_name, "clock": "realtime"}
        recorder = session.record(
            bag, namespace, {RUN_RECORD: run, "pendulum.excitation": dict(play.prediction)}, "mcap"
        )
        of_joints = {"plant": absolute_plant(str(play.prediction["plant"]))} if play.joint else {}
        zero = graph.controller(
            namespace, controller="playback", file=str(play.zero_file(logs).resolve()), period=play.period, **of_joints
        )
        signal = graph.disturbance(
            namespace,
            kind="from_bag",
            file=str(play.file.resolve()),
            duration=float(play.duration),
            **({"joints": [play.joint]} if play.joint else {}),
        )
        for program, name in ((zero, "zero_torque"), (signal, "excitation")):
            start_loop(session.processes, replace(program, name=name), ANSWER_PRIORITY)
        plant.wait_until_ready(START_TIMEOUT)
        wanted = {f"{namespace}/{topic}" for topic in (names.JOINT_STATES, names.APPLIED_EFFORT, names.DISTURBANCE)}
        RecorderClient(orchestrator, namespace).wait_until_heard(wanted, START_TIMEOUT)
        # Beyond its limits, or interrupted: release the drive now, not after the programs have ended.
        session.drives(plant)
        if not armed:
            plant.arm()
        plant.start_disturbance()
        orchestrator.wait_for("the end of the excitation", lambda: _watch(plant, play), play.duration + START_TIMEOUT)
        orchestrator.spin(_REST)
        if not armed:
            session.disarm_all()
        # The plant is its commander's again: an error of the bag must not disarm it.
        session.leaves(plant)
        session.close(recorder)
    return bag


def _find_plant(orchestrator: Orchestrator, namespace: str) -> str:
    topic = f"{namespace}/{names.JOINT_STATES}"
    node = orchestrator.node
    try:
        orchestrator.wait_for("", lambda: node.count_publishers(topic) > 0, _FIND_TIMEOUT)
    except FaultError:
        raise FaultError(
            f"no plant publishes {topic} in ROS domain {orchestrator.domain}; expected one: start it, or use --on sim"
        ) from None
    orchestrator.spin(1.0)  # discovery of other nodes takes a moment longer
    found = sorted({info.node_name for info in node.get_publishers_info_by_topic(topic)})
    if len(found) != 1:
        raise FaultError(f"{topic} is published by {', '.join(found)}; expected one plant")
    return found[0]


def _refuse_others(orchestrator: Orchestrator, namespace: str) -> None:
    for name in (names.EFFORT_COMMAND, names.DISTURBANCE):
        topic = f"{namespace}/{name}"
        others = sorted(
            names.full_name(info.node_namespace, info.node_name)
            for info in orchestrator.node.get_publishers_info_by_topic(topic)
        )
        if others:
            raise FaultError(
                f"{topic} has a publisher, {', '.join(others)}; expected none: end it before exciting the plant"
            )


def _require_rest(orchestrator: Orchestrator, plant: PlantClient, coordinates: Coordinates) -> None:
    for _ in range(10):
        orchestrator.spin(0.05)
        sample = plant.sample
        assert sample is not None
        hanging = coordinates.deviation(sample.position, (0.0,) * len(sample.position))
        for joint, q, v in zip(coordinates.joints, hanging, sample.velocity, strict=True):
            # Negated, so that NaN is refused too.
            if not (abs(q) <= _AT_REST_ANGLE and abs(v) <= _AT_REST_SPEED):
                whose = f" ({joint.name})" if len(hanging) > 1 else ""
                raise FaultError(
                    f"{plant.namespace} is at {q:.3f} {joint.unit} and {v:.3f} {joint.velocity_unit}{whose}; expected "
                    f"it hanging at rest, within {_AT_REST_ANGLE} {joint.unit} and {_AT_REST_SPEED} "
                    f"{joint.velocity_unit}"
                )


def _is_armed(plant: PlantClient, *, may_arm: bool) -> bool:
    if plant.is_armed():
        return True
    if not may_arm:
        state = f"is {mode}" if (mode := plant.newest_mode()) else "has not reported its mode"
        raise ParameterError(f"{plant.namespace} {state}; expected it armed, or --arm to arm it for the excitation")
    return False


def _watch(plant: PlantClient, play: ExcitationPlay) -> bool:
    plant.check_mode()
    sample = plant.sample
    assert sample is not None
    hanging = play.coordinates.deviation(sample.position, (0.0,) * len(sample.position))
    for joint, q, v, reach in zip(play.coordinates.joints, hanging, sample.velocity, play.reach, strict=True):
        for value, limit, unit in (
            (q, _ANGLE_ROOM * reach, joint.unit),
            (v, _SPEED_ROOM * play.speed, joint.velocity_unit),
        ):
            if not abs(value) <= limit:
                raise FaultError(
                    f"{plant.namespace} is at {value:.3g} {unit}; expected at most {limit:.3g} {unit}: the plant is "
                    "not what the excitation was designed for; it is disarmed"
                )
    return plant.newest_event(Event.NOISE_END) is not None
