"""Stops pressed in a real browser while something is broken: whatever was frozen, killed or cut off, no stop is lost.

The plant is driven by a constant torque. A try is judged by the plant's own events and torques, heard by a node that
knows nothing of the console. It survives when the plant is stopped, and its torque zero for good, within ``MAX_DELAY``
of the press, or of the moment at which the way to the plant was whole again, and when the page showed in red what did
not answer. Where nothing is measured, on a machine that does something else as well, a rig may have more patience.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.tools.faults.outcome import Outcome

__all__ = ["CHROMIUM", "MAX_DELAY", "QUIET", "SLOW_DISPLAY", "STOPS", "StopRig"]

CHROMIUM = Path("/usr/bin/chromium")
QUIET = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
SLOW_DISPLAY = """
    const next = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (draw) => setTimeout(() => next(draw), 200);
"""
"""Has a page draw five pictures a second: without a graphics card sixty take a third of a core."""
MAX_DELAY = 5.0
"""Longest time from a whole way to a stopped plant [s]: a service may have to be found anew, on a busy machine."""
_TORQUE = 0.5
"""What drives the plant while it is armed [N m]."""
_HELD = 1.5
"""How long something is held up while the stop is pressed [s]."""
_WATCH_WORDS = """words => {
    const place = document.getElementById("alarms");
    let gone = false;
    const watch = new MutationObserver(() => { gone ||= !place.textContent.includes(words); });
    watch.observe(place, {childList: true, subtree: true, characterData: true});
    window.tookBack = () => { watch.disconnect(); return gone || !place.textContent.includes(words); };
}"""
"""Notes whether words vanish from the alarms, be it for a moment."""
_AFTER = 0.3
"""How long the torque must stay zero after the page has shown the plant's answer [s]."""


class StopRig:
    """A simulator under constant torque, a console, a browser, and a witness on the graph.

    Args:
        folder: For logs.
        play: Playwright.
        patience: Longest time until plant and page have answered [s].
        slow_display: Whether pages draw seldom.
    """

    def __init__(self, folder: Path, play: Any, patience: float = MAX_DELAY, *, slow_display: bool = False) -> None:
        self.patience = patience
        self._slow_display = slow_display
        self._processes = ProcessGroup(folder / "logs", folder)
        self._folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.address = f"http://localhost:{self.port}/"
        self.modes: list[str] = []
        self.torques: list[tuple[float, float]] = []
        """When each applied torque was heard [s], and the torque [N m]: a plant that was frozen stamps late."""
        self._witness = GraphPeer("witness")
        self._witness.node.create_subscription(String, "/sim/events", self._hear, qos.EVENTS)
        applied = f"/sim/{names.APPLIED_EFFORT}"
        self._witness.node.create_subscription(JointState, applied, self._feel, qos.STATE, raw=True)
        self._drive = self._witness.node.create_publisher(JointState, f"/sim/{names.EFFORT_COMMAND}", qos.COMMAND)
        self._witness.node.create_subscription(
            JointState, f"/sim/{names.JOINT_STATES}", self._command, qos.NEWEST_STATE, raw=True
        )
        self._closing = threading.Event()
        self._listener = threading.Thread(target=self._listen, name="witness")
        self._listener.start()
        self.simulator = self.start_simulator()
        self.console = self.start_console()
        self.browser = play.chromium.launch(executable_path=str(CHROMIUM), args=QUIET)
        self.page = self.open()

    def close(self) -> list[str]:
        """End everything; return what had to be killed."""
        self.browser.close()
        self._closing.set()
        self._listener.join()
        self._witness.close()
        return self._processes.close()

    def start_simulator(self) -> RunningProgram:
        """Start the plant, which arms itself."""
        return self._processes.start(
            "pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim", "-p", "rate_hz:=100.0"
        )

    def start_console(self) -> RunningProgram:
        """Start the console on its port."""
        runs = self._folder / "runs"
        console = self._processes.start("pendulum_console", "console", "--port", str(self.port), "--runs", runs)
        console.wait_for_output(r"console at http://localhost", 60)
        return console

    def open(self, **options: Any) -> Any:
        """Open the page and wait until it shows the plant."""
        page = self.browser.new_page(**({"viewport": {"width": 1280, "height": 860}} | options))
        if self._slow_display:
            page.add_init_script(SLOW_DISPLAY)
        page.goto(self.address)
        page.wait_for_selector("[data-plant='/sim'] .armed_effort, [data-plant='/sim'] .disarmed", timeout=60_000)
        return page

    def rearm(self) -> None:
        """Acknowledge what is shown, reset the e-stop and arm, all through the page, until torque drives the plant."""
        deadline = time.monotonic() + 60.0
        while not (self.is_driven() and self.page.locator("#alarms button").count() == 0):
            if time.monotonic() > deadline:
                shown = self.page.locator("#alarms").inner_text()
                raise TimeoutError(f"waited 60 s for a driven plant; it is {self.modes[-3:]}, the page shows {shown!r}")
            # A button may be gone by the time that it is pressed.
            with suppress(Exception):
                if self.page.locator("#alarms button").count():
                    self.page.locator("#alarms button").first.click(timeout=500)
                elif self.modes[-1:] == ["e_stop"]:
                    self.page.get_by_role("button", name="Reset e-stop /sim").click(timeout=500)
                elif self.modes[-1:] in (["disarmed"], ["fault"]):
                    self.page.get_by_role("button", name="Arm /sim", exact=True).click(timeout=500)
            time.sleep(0.1)

    def is_driven(self) -> bool:
        """Tell whether torque acts on the plant now."""
        heard, torque = self.torques[-1] if self.torques else (0.0, 0.0)
        return self.modes[-1:] == ["armed_effort"] and torque != 0.0 and time.monotonic() - heard < 0.2

    def until_stopped(self) -> bool:
        """Wait until the plant says that it is stopped; tell whether it did in time."""
        return _soon(lambda: self.modes[-1:] == ["e_stop"], self.patience)

    def time_to_zero(self, since: float) -> float | None:
        """Return the time from a moment until the torque was zero for good [s]; None if it is not."""
        torques = list(self.torques)
        driven = max((heard for heard, torque in torques if torque != 0.0), default=0.0)
        zero = next((heard for heard, torque in torques if heard > max(driven, since) and torque == 0.0), None)
        return None if zero is None else zero - since

    def sees(self, text: str, page: Any = None) -> bool:
        """Tell whether the page comes to show a text among its alarms, in red."""
        with suppress(Exception):
            (page or self.page).locator("#alarms .bad", has_text=text).first.wait_for(timeout=1e3 * self.patience)
            return True
        return False

    def _listen(self) -> None:
        while not self._closing.is_set():
            self._witness.spin_once(0.1)

    def _command(self, data: bytes) -> None:
        if (state := decode_joint_state(data)) is not None:
            self._drive.publish(encode_joint_state(state.stamp_ns, frame_id="witness", effort=_TORQUE))

    def _feel(self, data: bytes) -> None:
        applied = decode_joint_state(data)
        if applied is not None and applied.effort:
            self.torques.append((time.monotonic(), applied.effort[0]))

    def _hear(self, message: String) -> None:
        event = json.loads(message.data)
        if event.get("name") == "plant_mode":
            self.modes.append(str(event["mode"]))


def _judge(rig: StopRig, outcome: Outcome, since: float) -> Outcome:
    outcome.demand(rig.until_stopped(), f"the plant is not stopped {rig.patience:g} s later, it is {rig.modes[-3:]}")
    # The page says so, too, and nothing wakes armed or moves afterwards.
    outcome.demand(
        _soon(lambda: rig.page.locator("#alarms .good").count() > 0, rig.patience),
        "the page does not show the plant's answer",
    )
    _soon(lambda: rig.time_to_zero(since) is not None, rig.patience)
    time.sleep(_AFTER)
    outcome.demand(rig.modes[-1:] == ["e_stop"], f"the plant became {rig.modes[-1:]} again")
    outcome.time_to_zero = rig.time_to_zero(since)
    outcome.demand(outcome.time_to_zero is not None, "torque still acts")
    return outcome


def _soon(holds: Callable[[], bool], timeout: float) -> bool:
    deadline = time.monotonic() + timeout
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def _frozen_plant(press: Callable[[StopRig], None]) -> Callable[[StopRig], Outcome]:
    def act(rig: StopRig) -> Outcome:
        outcome = Outcome()
        rig.simulator.send_signal(signal.SIGSTOP)
        try:
            press(rig)
            outcome.demand(rig.sees("HAS NOT ANSWERED"), "the page does not say that the plant has not answered")
            time.sleep(_HELD)
        finally:
            since = time.monotonic()
            rig.simulator.send_signal(signal.SIGCONT)
        return _judge(rig, outcome, since)

    return act


def _press_escape(rig: StopRig) -> None:
    rig.page.keyboard.press("Escape")


def _press_its_button(rig: StopRig) -> None:
    rig.page.get_by_role("button", name="Stop /sim", exact=True).click()


def _killed_plant(rig: StopRig) -> Outcome:
    outcome = Outcome()
    rig.simulator.send_signal(signal.SIGKILL)
    rig.page.keyboard.press("Escape")
    outcome.demand(rig.sees("HAS NOT ANSWERED"), "the page does not say that the plant has not answered")
    rig.simulator = rig.start_simulator()
    rig.simulator.wait_for_output(r"\[INFO\]", 60)
    return _judge(rig, outcome, time.monotonic())


def _plant_gone_for_long(rig: StopRig) -> Outcome:
    outcome = Outcome()
    rig.simulator.send_signal(signal.SIGKILL)
    gone = rig.page.locator("#alarms .note", has_text="gone from the graph").first
    with suppress(Exception):
        gone.wait_for(timeout=20_000)
    outcome.demand(gone.count() > 0, "the page does not say that the plant is gone")
    rig.page.keyboard.press("Escape")
    rig.simulator = rig.start_simulator()
    rig.simulator.wait_for_output(r"\[INFO\]", 60)
    return _judge(rig, outcome, time.monotonic())


def _frozen_server(rig: StopRig) -> Outcome:
    outcome = Outcome()
    rig.console.send_signal(signal.SIGSTOP)
    try:
        rig.page.keyboard.press("Space")
        outcome.demand(rig.sees("HAS NOT REACHED"), "the page does not say that the server has not taken the stop")
        rig.page.evaluate(_WATCH_WORDS, "HAS NOT REACHED")
        time.sleep(_HELD)
        outcome.demand(not rig.page.evaluate("tookBack()"), "the page took its words back")
    finally:
        since = time.monotonic()
        rig.console.send_signal(signal.SIGCONT)
    return _judge(rig, outcome, since)


def _killed_server(rig: StopRig) -> Outcome:
    outcome = Outcome()
    rig.console.send_signal(signal.SIGKILL)
    rig.console.wait(10.0)
    rig.page.keyboard.press("Space")
    outcome.demand(rig.sees("HAS NOT REACHED"), "the page does not say that the server has not taken the stop")
    outcome.demand(rig.sees("NO ANSWER FROM"), "the page does not say that the server is silent")
    rig.console = rig.start_console()
    return _judge(rig, outcome, time.monotonic())


def _server_dies_after_the_answer(rig: StopRig) -> Outcome:
    outcome = Outcome()
    since = time.monotonic()
    rig.page.keyboard.press("Escape")
    outcome.demand(_soon(lambda: rig.page.locator("#alarms .good").count() > 0, rig.patience), "no answer is shown")
    rig.console.send_signal(signal.SIGKILL)
    rig.console.wait(10.0)
    outcome.demand(rig.sees("UNCONFIRMED"), "the page does not say that the answer is no longer confirmed")
    outcome.demand(rig.page.locator("#alarms .good").count() == 0, "what nobody confirms stays green")
    rig.console = rig.start_console()
    return _judge(rig, outcome, since)


def _cut_link(rig: StopRig) -> Outcome:
    outcome = Outcome()
    session = rig.page.context.new_cdp_session(rig.page)
    session.send("Network.enable")
    cut = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    session.send("Network.emulateNetworkConditions", cut)
    try:
        rig.page.keyboard.press("Escape")
        outcome.demand(rig.sees("HAS NOT REACHED"), "the page does not say that the server has not taken the stop")
        time.sleep(_HELD)
    finally:
        whole = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        since = time.monotonic()
        session.send("Network.emulateNetworkConditions", whole)
    return _judge(rig, outcome, since)


def _two_clients(rig: StopRig) -> Outcome:
    outcome = Outcome()
    phone = rig.open(viewport={"width": 390, "height": 844}, has_touch=True)
    try:
        since = time.monotonic()
        phone.locator("#e_stop").tap()
        _judge(rig, outcome, since)
        seen = _soon(lambda: phone.locator("#alarms .good").count() > 0, rig.patience)
        outcome.demand(seen, "the client that pressed does not show the answer")
    finally:
        phone.close()
    return outcome


def _page_in_the_background(rig: StopRig) -> Outcome:
    outcome = Outcome()
    rig.simulator.send_signal(signal.SIGSTOP)
    other = rig.browser.new_page()
    try:
        rig.page.bring_to_front()
        rig.page.keyboard.press("Escape")
        other.bring_to_front()
        time.sleep(_HELD)
    finally:
        since = time.monotonic()
        rig.simulator.send_signal(signal.SIGCONT)
    _judge(rig, outcome, since)
    other.close()
    return outcome


def _closed_page(rig: StopRig) -> Outcome:
    outcome = Outcome()
    other = rig.open()
    rig.simulator.send_signal(signal.SIGSTOP)
    try:
        other.keyboard.press("Escape")
        outcome.demand(rig.sees("HAS NOT ANSWERED"), "the other client does not see that the plant has not answered")
        other.close()
        time.sleep(_HELD)
    finally:
        since = time.monotonic()
        rig.simulator.send_signal(signal.SIGCONT)
    return _judge(rig, outcome, since)


def _pressed(press: Callable[[Any], object]) -> Callable[[StopRig], Outcome]:
    def act(rig: StopRig) -> Outcome:
        since = time.monotonic()
        press(rig.page)
        return _judge(rig, Outcome(), since)

    return act


def _key_on_the_button(page: Any) -> None:
    page.locator("#e_stop").focus()
    page.keyboard.press("Enter")


STOPS: dict[str, Callable[[StopRig], Outcome]] = {
    "stop by mouse": _pressed(lambda page: page.locator("#e_stop").click()),
    "stop by Space": _pressed(lambda page: page.keyboard.press("Space")),
    "stop by Escape": _pressed(lambda page: page.keyboard.press("Escape")),
    "stop by Enter on the button": _pressed(_key_on_the_button),
    "stop by click() as a screen reader sends it": _pressed(
        lambda page: page.evaluate("document.getElementById('e_stop').click()")
    ),
    "stop by touch on a second client": _two_clients,
    "stop while the plant is frozen": _frozen_plant(_press_escape),
    "stop while the plant is killed and started anew": _killed_plant,
    "stop after the plant was gone for long": _plant_gone_for_long,
    "stop while the console's server is frozen": _frozen_server,
    "stop while the console's server is killed and started anew": _killed_server,
    "stop, then the console's server is killed and started anew": _server_dies_after_the_answer,
    "stop while the link to the server is cut": _cut_link,
    "stop of one plant alone, by its own button, while it is frozen": _frozen_plant(_press_its_button),
    "stop, then the page goes to the background, plant frozen": _page_in_the_background,
    "stop, then the page that pressed is closed, plant frozen": _closed_page,
}
"""What is done, by the name that the table gives it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Try each stop several times and print a table; return 1 where one was lost or the page in the wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.faults.console_stops",
        description=main.__doc__,
        epilog="Example: python -m tests.tools.faults.console_stops 20 frozen mouse",
    )
    parser.add_argument("tries", nargs="?", type=int, default=20, help="how often each way is tried")
    parser.add_argument("names", nargs="*", help="only the ways whose names have one of these in them")
    parser.add_argument("--list", action="store_true", help="print the names of the ways and end")
    options = parser.parse_args(argv)
    if options.list:
        print("\n".join(STOPS))
        return 0
    if options.tries < 1:
        parser.error(f"tries is {options.tries}; expected at least 1")
    if unknown := [part for part in options.names if not any(part in name for name in STOPS)]:
        parser.error(f"no stop has {unknown[0]!r} in its name; expected a part of one of those that --list prints")
    wanted = options.names or [""]
    chosen = {name: act for name, act in STOPS.items() if any(part in name for part in wanted)}
    from playwright.sync_api import sync_playwright

    from pendulum_bags.experiments.domain import reserve_domain

    failed = 0
    with tempfile.TemporaryDirectory() as folder, reserve_domain() as domain, sync_playwright() as play:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        rig = StopRig(Path(folder), play)
        try:
            print("| stop | presses | lost | page in the wrong | median [s] | longest [s] | remarks |")
            print("|---|---|---|---|---|---|---|")
            for name, act in chosen.items():
                failed += _row(rig, name, act, options.tries)
        finally:
            rig.close()
    return int(failed > 0)


def _row(rig: StopRig, name: str, act: Callable[[StopRig], Outcome], tries: int) -> int:
    outcomes = []
    for _ in range(tries):
        rig.rearm()
        outcomes.append(act(rig))
    times = [outcome.time_to_zero for outcome in outcomes if outcome.time_to_zero is not None]
    lost = tries - len(times)
    wrong = sum(not outcome.survived for outcome in outcomes) - lost
    remarks = "; ".join(sorted({outcome.detail for outcome in outcomes if outcome.detail}))
    median = statistics.median(times) if times else float("nan")
    longest = max(times, default=float("nan"))
    print(f"| {name} | {tries} | {lost} | {wrong} | {median:.2f} | {longest:.2f} | {remarks} |", flush=True)
    return lost + wrong


if __name__ == "__main__":
    raise SystemExit(main())
