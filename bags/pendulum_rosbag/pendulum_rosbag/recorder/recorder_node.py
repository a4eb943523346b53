"""The recorder node: subscribes to topics as they appear and writes them to a bag."""

from __future__ import annotations

import json
import platform
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.plant_specs import REALTIME_PRIORITY
from pendulum_msgs_py.errors import BagError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros.convert import event_message
from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD, Diagnostics
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.timers import create_wall_timer
from pendulum_rosbag import __version__
from pendulum_rosbag.recorder.black_box import BlackBox
from pendulum_rosbag.recorder.options import RecorderOptions
from pendulum_rosbag.recorder.parameter_reader_node import ParameterReader
from pendulum_rosbag.recorder.recorder_tap_node import Tap
from pendulum_rosbag.recorder.session import RecordingSession, SessionReport
from pendulum_rosbag.storage import BagWriter, QosProfile
from pendulum_rosbag.storage.message_types import message_type

__all__ = ["SPECS", "Recorder"]

POLL_PERIOD = 0.02
"""Period of polling the middleware [s]; the middleware stamps the arrival, so polling costs no precision."""
DISCOVERY_PERIOD = 0.2
"""Period of graph polls [s]."""

SPECS = (
    ParameterSpec(
        "annotation",
        "",
        "-",
        "A note for the recording; setting it writes the event 'annotation', as the service ~/annotate does again.",
    ),
    REALTIME_PRIORITY,
)


class Recorder(PollingNode):
    """Subscribes to topics as they appear and hands their bytes to a :class:`RecordingSession`.

    Messages are polled every 20 ms, at a tenth of an executor's cost. A BagError if the output folder is not new.
    """

    def __init__(self, options: RecorderOptions, stop: Callable[[], None]) -> None:
        self._taps: dict[str, Tap] = {}
        super().__init__(names.RECORDER)
        self.exit_code = 0
        self.reports: list[SessionReport] = []
        self._options = options
        self._stop = stop
        self._session: RecordingSession | None = None
        self._started = time.monotonic()
        self._newest_stamp = 0
        self._unstamped: list[tuple[Tap, int, bytes]] = []
        self._refused: dict[str, str] = {}
        self._lock = threading.RLock()
        self._events = f"{self.get_fully_qualified_name()}/{names.EVENTS}"
        self._settings = NodeParameters(self, SPECS, apply=self._on_parameters)
        self._parameter_reader = ParameterReader(self, self._on_node_parameters)
        self._black_box: BlackBox[Tap] | None = None
        if options.black_box:
            self._black_box = BlackBox(options.black_box)
            self._diagnostics = Diagnostics(self, "black box")
            create_wall_timer(self, DIAGNOSTICS_PERIOD, self._publish_black_box)
        elif not options.wait:
            self._begin()
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/annotate", self._on_annotate)
        self.create_service(Trigger, "~/status", self._on_status)
        self._discover()
        # Steady time: discovery must not depend on system or simulated time.
        create_wall_timer(self, DISCOVERY_PERIOD, self._discover)
        self._leave = threading.Event()
        self._poller = threading.Thread(target=self._poll, name="bag intake", daemon=True)
        self._poller.start()

    def close(self) -> None:
        """Take what has arrived, close the bag and log its contents."""
        self._leave.set()
        self._poller.join()
        self._end()

    def _begin(self) -> RecordingSession:
        number = len(self.reports)
        base = self._options.output
        path = base if not number else base.with_name(f"{base.name}_{number + 1}")
        options = self._options
        writer = BagWriter(
            path,
            options.storage,
            options.compression,
            {**self._provenance(), **options.metadata},
            max_size=options.max_size,
            max_duration=options.max_duration,
        )
        with self._lock:
            session = self._session = RecordingSession(writer, on_failure=self._on_failure)
            session.add_topic(self._events, message_type("std_msgs/msg/String"), [QosProfile()])
        self._started = time.monotonic()
        print(f"recording to {writer.path}", flush=True)
        return session

    def _end(self) -> SessionReport | None:
        with self._lock:
            session = self._session
            if session is None:
                return None
            self._take_all()
            self._offer_unstamped(session)
            session.update_metadata({"pendulum.parameters": self._parameter_reader.values})
            self._session = None
            report = session.close()
        report.unrecorded = self._options.unmet(self._taps) | self._refused
        self.reports.append(report)
        self.exit_code = 1 if report.failed else self.exit_code
        print(
            f"{'error: ' if report.failed else ''}recorded {report.sentence()}",
            file=sys.stderr if report.failed else sys.stdout,
            flush=True,
        )
        return report

    def _provenance(self) -> dict[str, Any]:
        import rclpy

        return {
            "pendulum.recorder": {
                "version": __version__,
                "log_time": self._options.log_time,
                "started_ns": time.time_ns(),
                "host": platform.node(),
                "system": platform.platform(),
                "python": platform.python_version(),
                "rmw": rclpy.get_rmw_implementation_identifier(),
            }
        }

    def _on_failure(self, reason: str) -> None:
        self.get_logger().error(f"recording stops: {reason}")
        self._stop()

    def _poll(self) -> None:
        try:
            self._poll_until_stopped()
        except Exception as error:  # noqa: BLE001  # a recorder that receives nothing any more must not seem alive
            self.exit_code = 1
            with self._lock:
                if self._session is not None:
                    self._session.fail(error)
            self._stop()

    def _poll_until_stopped(self) -> None:
        while not self._leave.wait(POLL_PERIOD):
            with self._lock:
                self._take_all()
            self._write_black_box()
            if self._options.duration and time.monotonic() - self._started >= self._options.duration:
                self._stop()

    def _take_all(self) -> None:
        session = self._session
        for tap in list(self._taps.values()):
            self._take(tap, session)
        if session is not None and self._unstamped and self._newest_stamp:
            self._offer_unstamped(session)

    def _take(self, tap: Tap, session: RecordingSession | None) -> None:
        items: list[tuple[int, bytes]] = []
        missing = repeated = 0
        by_header = self._options.log_time == "header"
        for received_ns, data, gap in tap.take():
            missing += gap
            time_ns = received_ns or time.time_ns()
            if by_header:
                stamp = self._stamp(tap, data)
                if stamp is None:
                    self._unstamped.append((tap, time_ns, data))
                    continue
                if tap.repeats(session, data):
                    repeated += 1
                    continue
                time_ns = stamp
            items.append((time_ns, data))
        unheard = tap.unheard()
        if session is None:
            self._unstamped.clear()
            if self._black_box is not None:
                self._black_box.keep(tap, items)
                if tap.topic.endswith(f"/{names.EVENTS}"):
                    for time_ns, data in items:
                        self._black_box.poll(data, time_ns)
            return
        if items or missing:
            self._offer(tap, session, items, missing)
        if repeated:
            tap.announce(session)
            session.note(tap.topic, repeated=repeated)
        if unheard and tap.is_new:
            tap.announce(session)
            session.note(tap.topic, before=unheard)
        elif unheard:
            self._tell_early(tap, session, unheard)

    def _write_black_box(self) -> None:
        box = self._black_box
        if box is None or self._session is not None or not box.is_due(time.time_ns()):
            return
        with self._lock:
            session = self._begin()
            for tap, time_ns, data in box.empty():
                self._offer(tap, session, [(time_ns, data)])
            self.note("black_box", reason=box.reason)
            self._end()
        self._publish_black_box()

    def _publish_black_box(self) -> None:
        assert self._black_box is not None
        written = [str(report.path) for report in self.reports]
        values = {"black_box": written[-1] if written else "", "reason": self._black_box.reason, "bags": len(written)}
        text = f"wrote {written[-1]}" if written else "waits for a fault or an e-stop"
        self._diagnostics.publish(time.time_ns(), DiagnosticStatus.OK, text, values)

    def _offer(self, tap: Tap, session: RecordingSession, items: Sequence[tuple[int, bytes]], missing: int = 0) -> None:
        tap.announce(session)
        if missing and tap.is_settling:
            self._tell_early(tap, session, missing)
            missing = 0
        refused = session.offer(tap.topic, items)
        if missing:
            session.note(tap.topic, missing=missing)
        if missing or refused:
            why = "the disk failed" if session.failure else "the disk does not keep up"
            self.get_logger().error(
                f"LOST {missing + refused} messages of {tap.topic} ({missing} by the middleware, {refused} because "
                f"{why})"
            )

    def _tell_early(self, tap: Tap, session: RecordingSession, count: int) -> None:
        tap.announce(session)
        session.note(tap.topic, early=count)
        self.get_logger().warning(
            f"{count} messages of {tap.topic} are not recorded: they were published before the subscription was "
            "complete"
        )

    def _stamp(self, tap: Tap, data: bytes) -> int | None:
        """Return the log time by header; unstamped messages get the newest stamp, for which the first ones wait."""
        stamp = tap.stamp(data) if tap.stamp is not None else None
        if stamp is None or stamp < 0:
            return self._newest_stamp or None
        self._newest_stamp = max(self._newest_stamp, stamp)
        return stamp

    def _offer_unstamped(self, session: RecordingSession) -> None:
        for tap, received_ns, data in self._unstamped:
            self._offer(tap, session, [(self._newest_stamp or received_ns, data)])
        self._unstamped.clear()

    def _discover(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if not self._options.wants(topic) or topic == self._events:
                continue
            tap = self._taps.get(topic)
            if tap is not None and len(types) == 1 and self.count_publishers(topic) == tap.publishers:
                continue
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            # A subscription of another type receives nothing and is no reason to refuse the topic.
            published = {publisher.topic_type for publisher in publishers}
            if tap is not None:
                published.add(tap.type_name)
            if len(published) > 1:
                self._refuse(topic, f"it has the types {', '.join(sorted(published))}; expected one")
                continue
            self._tap(topic, publishers)
        self._parameter_reader.poll()

    def _tap(self, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        tap = self._taps.get(topic)
        if tap is not None:
            if tap.suits(publishers):
                return
            # A new publisher offers less than was requested and would never match: request less.
            with self._lock:
                self._take(tap, self._session)
                del self._taps[topic]
            tap.close()
            self.destroy_polled_input(tap.source)
        with self._lock:
            try:
                self._taps[topic] = Tap(self, topic, publishers, tap)
            except ImportError:
                self._refuse(topic, f"its type {publishers[0].topic_type} cannot be imported")
                return
        print(f"subscribed to {topic} ({publishers[0].topic_type})", flush=True)

    def _refuse(self, topic: str, reason: str) -> None:
        if topic not in self._refused:
            self._refused[topic] = reason
            self.get_logger().error(f"{topic} is NOT recorded: {reason}")

    def note(self, name: str, **details: Any) -> None:
        """Write an event of the recorder itself to the bag."""
        by_header = self._options.log_time == "header"
        stamp = self._newest_stamp if by_header and self._newest_stamp else time.time_ns()
        text = event_message(stamp, name, **details).data.encode() + b"\0"
        data = b"\x00\x01\x00\x00" + len(text).to_bytes(4, "little") + text
        with self._lock:
            if self._session is not None:
                self._session.offer(self._events, [(stamp, data)])

    def _on_parameters(self, values: Mapping[str, Any]) -> None:
        if values["annotation"]:
            self.note("annotation", text=values["annotation"])

    def _on_node_parameters(self, values: Mapping[str, Mapping[str, Any]], changed: str) -> None:
        with self._lock:
            if self._session is not None:
                self._session.update_metadata({"pendulum.parameters": values})
        if changed:
            self.note("parameters_changed", node=changed, values=values[changed])

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._session is not None:
            response.success, response.message = False, f"recording to {self._session.writer.path} already"
            return response
        try:
            self._begin()
        except BagError as error:
            response.success, response.message = False, str(error)
            return response
        response.success, response.message = True, str(self._session.writer.path) if self._session else ""
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        report = self._end()
        response.success = report is not None and not report.failed
        response.message = report.sentence() if report is not None else "nothing is being recorded"
        return response

    def _on_annotate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.note("annotation", text=self._settings["annotation"])
        response.success = self._session is not None
        response.message = "noted" if response.success else "nothing is being recorded"
        return response

    def _on_status(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        session = self._session
        counts = session.counts() if session is not None else {}
        response.success = session is not None
        response.message = json.dumps(
            {
                "path": str(session.writer.path) if session is not None else None,
                "subscribed": sorted(self._taps),
                "matched": sorted(
                    tap.topic for tap in self._taps.values() if tap.source.subscription.get_publisher_count()
                ),
                "topics": {
                    name: {"received": count.received, "written": count.written, "lost": count.refused + count.missing}
                    for name, count in counts.items()
                },
            }
        )
        return response
