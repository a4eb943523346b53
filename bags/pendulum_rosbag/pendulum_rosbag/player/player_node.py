"""``play``: publish the topics of a bag again over DDS, with ``/clock``."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract.names import CLOCK
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.ros.convert import class_of, stamp_to_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_rosbag.reader import Bag, read_bag
from pendulum_rosbag.storage.qos import profiles_of

__all__ = ["PlayOptions", "Player", "main"]

SPECS = (
    ParameterSpec(
        "rate",
        1.0,
        "-",
        "Speed relative to the recording; may be changed while playing.",
        minimum=0.0,
        exclusive_minimum=True,
    ),
    ParameterSpec("clock_rate", 100.0, "Hz", "Messages on /clock a second of wall time; 0 for none.", minimum=0.0),
)
_LONGEST_WAIT = 0.05  # latency of pause, stop and a new rate [s]
_DEPTH = 1000


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """What to play, and how.

    Args:
        bag: Folder of the bag, or one storage file.
        topics: Topics to play; empty for all.
        remaps: Recorded name -> name to publish under.
        start: Time after the beginning of the bag to start at [s].
        duration: Time of the recording to play [s]; 0 for all.
        loop: Restart at the end.
        wait: Longest time to wait for a subscriber on every topic before the first message [s].
        paused: Start when the service ``~/pause`` is called with false.
    """

    bag: Path
    topics: tuple[str, ...] = ()
    remaps: tuple[tuple[str, str], ...] = ()
    start: float = 0.0
    duration: float = 0.0
    loop: bool = False
    wait: float = 2.0
    paused: bool = False

    def __post_init__(self) -> None:
        for name, value in (("start", self.start), ("duration", self.duration), ("wait", self.wait)):
            if not value >= 0:
                raise ParameterError(f"{name} is {value} s; expected >= 0")


class _Timeline:
    """Recorded time as a function of wall time, with changing rate and pauses."""

    def __init__(self, start_ns: int, rate: float, paused: bool) -> None:
        self._rate = rate
        self._paused = paused
        self._anchor = (time.monotonic_ns(), start_ns)

    def now(self) -> int:
        wall, recorded = self._anchor
        return recorded if self._paused else recorded + round((time.monotonic_ns() - wall) * self._rate)

    def wait_for(self, recorded_ns: int) -> float:
        return _LONGEST_WAIT if self._paused else (recorded_ns - self.now()) / self._rate * 1e-9

    def change(self, *, rate: float | None = None, paused: bool | None = None, jump_to: int | None = None) -> None:
        self._anchor = (time.monotonic_ns(), self.now() if jump_to is None else jump_to)
        self._rate = self._rate if rate is None else rate
        self._paused = self._paused if paused is None else paused


class Player(Node):
    """Publishes recorded bytes at recorded times, of any installed type; ``stop`` requests the process to end.

    Raises:
        BagError: There is no readable bag.
        DataError: A topic is missing, or there is nothing to play.
    """

    def __init__(self, options: PlayOptions, stop: Callable[[], None]) -> None:
        super().__init__("player")
        self.exit_code = 0
        self._stop = stop
        self._options = options
        self._settings = NodeParameters(self, SPECS, apply=self._on_parameters)
        bag = read_bag(options.bag, list(options.topics) or None)
        self._times, self._order, self._datas, names = _schedule(bag, options)
        self._outputs = [self._publisher(bag, name) for name in names]
        own_clock = CLOCK not in names and self._settings["clock_rate"] > 0
        self._clock_output = self.create_publisher(Clock, CLOCK, QoSProfile(depth=10)) if own_clock else None
        self._timeline = _Timeline(int(self._times[0]), self._settings["rate"], True)
        self.published = 0
        self.latest = 0.0
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/status", self._on_status)
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        print(
            f"playing {len(self._times)} messages of {len(names)} topics, "
            f"{(self._times[-1] - self._times[0]) * 1e-9:.3f} s at rate {self._settings['rate']:g}",
            flush=True,
        )
        self._thread.start()

    def close(self) -> None:
        """Stop publishing and log what was done."""
        self._leave.set()
        self._thread.join()
        print(f"played {self.published} messages, the latest {self.latest * 1e3:.1f} ms behind its time", flush=True)

    def _publisher(self, bag: Bag, name: str) -> Publisher:
        info = bag.topics[name]
        try:
            message_class = class_of(info.type)
        except ImportError as error:
            raise DataError(f"topic {name} has type {info.type}, which is not installed here") from error
        new_name = dict(self._options.remaps).get(name, name)
        return self.create_publisher(message_class, new_name, _recorded_qos(info.qos))

    def _run(self) -> None:
        if not self._wait_for_subscribers():
            return
        self._timeline.change(paused=self._options.paused)
        while not self._leave.is_set():
            if not self._play_once():
                return
            if not self._options.loop:
                break
            self._timeline.change(jump_to=int(self._times[0]))
        # Reliable subscribers must have acknowledged before the publishers vanish.
        for publisher in self._outputs:
            publisher.wait_for_all_acked()
        self._stop()

    def _wait_for_subscribers(self) -> bool:
        end = time.monotonic() + self._options.wait
        while time.monotonic() < end and not all(output.get_subscription_count() for output in self._outputs):
            if self._leave.wait(_LONGEST_WAIT):
                return False
        return True

    def _play_once(self) -> bool:
        clock_due = 0
        times, order, datas = self._times.tolist(), self._order.tolist(), self._datas
        for time_ns, topic, data in zip(times, order, datas, strict=True):
            while (wait := self._timeline.wait_for(time_ns)) > 0:
                clock_due = self._tell_time(clock_due, min(self._timeline.now(), time_ns))
                if self._leave.wait(min(wait, _LONGEST_WAIT, self._clock_period())):
                    return False
            self._outputs[topic].publish(data)
            self.published += 1
            self.latest = max(self.latest, -wait)
            clock_due = self._tell_time(clock_due, time_ns)
        return True

    def _clock_period(self) -> float:
        rate = self._settings["clock_rate"]
        return 1.0 / rate if self._clock_output is not None and rate > 0 else _LONGEST_WAIT

    def _tell_time(self, due: int, recorded_ns: int) -> int:
        """Publish ``/clock`` if due; return when it is due next [ns of the monotonic clock]."""
        now = time.monotonic_ns()
        if self._clock_output is None or now < due:
            return due
        self._clock_output.publish(Clock(clock=stamp_to_message(recorded_ns)))
        return now + round(self._clock_period() * 1e9)

    def _on_parameters(self, values: Any) -> None:
        self._timeline.change(rate=values["rate"])

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._timeline.change(paused=request.data)
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _on_status(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = json.dumps(
            {"published": self.published, "of": len(self._times), "recorded_ns": self._timeline.now()}
        )
        return response


def _schedule(bag: Bag, options: PlayOptions) -> tuple[Any, Any, list[bytes], list[str]]:
    """Return log times, topic indices and bytes of all messages in order, and the topic names."""
    begin = bag.start_ns + round(options.start * 1e9)
    end = begin + round(options.duration * 1e9) if options.duration else 2**63 - 1
    names: list[str] = []
    times: list[int] = []
    order: list[int] = []
    datas: list[bytes] = []
    for name in bag.topics:
        rows = [(t, data) for t, data in bag.raw(name) if begin <= t < end]
        if rows:
            times += [t for t, _ in rows]
            datas += [data for _, data in rows]
            order += [len(names)] * len(rows)
            names.append(name)
    if not times:
        raise DataError(f"bag {bag.path} has no message in the time asked for; nothing to play")
    rank = np.argsort(np.array(times), kind="stable")
    return np.array(times)[rank], np.array(order)[rank], [datas[i] for i in rank.tolist()], names


def _recorded_qos(text: str) -> QoSProfile:
    recorded = profiles_of(text)
    best_effort = any(profile.reliability == "best_effort" for profile in recorded)
    latched = bool(recorded) and all(profile.durability == "transient_local" for profile in recorded)
    return QoSProfile(
        depth=_DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def play(
    context: typer.Context,
    bag: Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap or .db3 file.")],
    topics: Annotated[list[str] | None, typer.Option("-t", "--topic", help="Topic to play; by default all.")] = None,
    rate: Annotated[float, typer.Option("-r", "--rate", help="Speed relative to the recording.")] = 1.0,
    remap: Annotated[list[str] | None, typer.Option(help="RECORDED:=NEW to publish under another name.")] = None,
    start: Annotated[float, typer.Option(help="Begin that long after the beginning of the bag [s].")] = 0.0,
    duration: Annotated[float, typer.Option(help="Play that much of the recording [s]; 0 for all.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    wait: Annotated[float, typer.Option(help="Wait at most that long for a subscriber on every topic [s].")] = 2.0,
    paused: Annotated[bool, typer.Option("--paused", help="Begin when ~/pause is called with false.")] = False,
    clock_rate: Annotated[float, typer.Option(help="Messages on /clock a second; 0 for none.")] = 100.0,
) -> int:
    """Publish the topics of a bag again, at recorded times, with /clock.

    Example: python -m pendulum_rosbag play runs/today/sim -t /sim/joint_states --remap
    /sim/joint_states:=/joint_states --rate 0.5. ROS arguments follow --ros-args.
    """
    pairs = []
    for text in remap or []:
        old, separator, new = text.partition(":=")
        if not separator or not old or not new:
            raise ParameterError(f"remap is {text!r}; expected RECORDED:=NEW")
        pairs.append((old, new))
    options = PlayOptions(bag, tuple(topics or ()), tuple(pairs), start, duration, loop, wait, paused)
    ros: Sequence[str] = [
        *context.obj,
        "--ros-args",
        "-p",
        f"rate:={float(rate)}",
        "-p",
        f"clock_rate:={float(clock_rate)}",
    ]
    return run_node(
        lambda stop: Player(options, stop),
        list(ros),
        program="pendulum_rosbag play",
        description="Publish the topics of a bag again.",
        specs=SPECS,
    )


main = command_line(play, "python -m pendulum_rosbag play", takes_ros_arguments=True)
