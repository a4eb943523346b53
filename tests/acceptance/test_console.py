"""The console in a real browser, on real plants: seen, tuned, stopped; and who is not let in."""

from __future__ import annotations

import json
import math
import re
import shutil
import signal
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pendulum_bags.verdict.layers import Layer, LayerResult, Mark, sum_up
from pendulum_console.console.security import refusal
from pendulum_testing.fixtures import PROJECT, own_domain, wait_for
from pendulum_testing.npm import install_packages
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.tools.faults import console_stops
from tests.tools.faults.console_stops import CHROMIUM, QUIET, SLOW_DISPLAY, STOPS, StopRig

AXE = PROJECT / "tests" / "axe"
IN_SHORT = (
    "stop by Enter on the button",
    "stop by click() as a screen reader sends it",
    "stop by touch on a second client",
    "stop while the plant is killed and started anew",
    "stop while the console's server is killed and started anew",
    "stop, then the console's server is killed and started anew",
    "stop while the link to the server is cut",
    "stop of one plant alone, by its own button, while it is frozen",
)
"""Ways to lose a stop, each tried once here (a plant is frozen by the last); all of them, 20 times:
``python -m tests.tools.faults.console_stops``."""
STOP_LIMIT_MS = 100.0
COVERED_BY_NOTICES = """() => {
    // A long notice scrolls: what its place does not show covers nothing.
    const notices = [...document.querySelectorAll(".notices, .q-notification")]
        .filter((it) => it.childElementCount).map((it) => it.getBoundingClientRect());
    return [...document.querySelectorAll("button, input, select, a")].map((it) => [it, it.getBoundingClientRect()])
        .filter(([it, box]) => box.width && notices.some((other) => box.left < other.right && other.left < box.right
            && box.top < other.bottom && other.top < box.bottom)).map(([it]) => it.outerHTML);
}"""
"""Controls under a notice, as the page shows both."""
PLACE_AMONG_PLANTS = """(button) => {
    const [own, all] = [button, document.querySelector(".plants")].map((it) => it.getBoundingClientRect());
    return [own.left - all.left, own.top - all.top];
}"""


@pytest.mark.parametrize(
    ("headers", "query", "token", "expected"),
    [
        ({"host": "localhost:8090"}, "", "", ""),
        ({"host": "127.0.0.1:8090", "origin": "http://127.0.0.1:8090"}, "", "", ""),
        ({"host": "localhost:8090", "origin": "https://evil.example"}, "", "", "another site"),
        ({"host": "evil.example:8090"}, "", "", "not this machine"),
        ({"host": "lab:8090"}, "", "secret", "token"),
        ({"host": "lab:8090"}, "token=secret", "secret", ""),
        ({"host": "lab:8090", "cookie": "pendulum_console=secret"}, "", "secret", ""),
        ({"host": "lab:8090", "cookie": "pendulum_console=guess"}, "", "secret", "token"),
        ({"host": "lab:8090", "origin": "http://evil"}, "token=secret", "secret", "another site"),
    ],
)
def test_only_own_pages_and_bearers_of_the_token_are_let_in(
    headers: dict[str, str], query: str, token: str, expected: str
) -> None:
    reason = refusal(headers, query, token)
    assert expected in reason
    assert bool(reason) is bool(expected)


@pytest.fixture(scope="module")
def play() -> Iterator[Any]:
    """Start Playwright, or skip where it or the browser is not there."""
    playwright = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.is_file():
        pytest.skip(f"no browser at {CHROMIUM}")
    with playwright.sync_playwright() as play:
        yield play


@pytest.fixture(scope="module")
def chromium(play: Any) -> Iterator[Any]:
    """Start Chromium."""
    chromium = play.chromium.launch(executable_path=str(CHROMIUM), args=QUIET)
    yield chromium
    chromium.close()


def test_the_page_doubts_a_silent_server_and_gives_its_orders_to_the_next() -> None:
    """The page's script alone: what it sends and shows while servers come and go, and when it is loaded anew."""
    if (node := shutil.which("node")) is None:
        pytest.skip("no node on this machine")
    script = PROJECT / "bags" / "pendulum_console" / "pendulum_console" / "console" / "static" / "console.js"
    ended = subprocess.run(
        [node, Path(__file__).with_name("console_page.cjs"), script],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr


def test_no_stop_is_lost_whatever_is_frozen_killed_or_cut_off(play: Any, domain_id: int, tmp_path: Path) -> None:
    rig = StopRig(tmp_path, play, patience=30.0, slow_display=True)
    try:
        for name in IN_SHORT:
            rig.rearm()
            outcome = STOPS[name](rig)
            assert outcome.survived, f"{name}: {outcome.detail}"
    finally:
        left = rig.close()
    assert left == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["1", "mouse", "frozzen"], "no stop has 'frozzen' in its name"), (["0"], "tries is 0; expected at least 1")],
)
def test_stops_that_nobody_can_try_are_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        console_stops.main(arguments)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


@dataclass
class Bench:
    """A simulator with controller and disturbance in /sim, and a console.

    Attributes:
        processes: All of them, and what a test starts beside them.
        simulator: The plant.
        address: The console's.
        runs: Folder of the runs that the console shows.
    """

    processes: ProcessGroup
    simulator: RunningProgram
    address: str
    runs: Path


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Start all that tests look at through a page, once; each leaves an armed plant to the next."""
    folder = tmp_path_factory.mktemp("bench")
    with own_domain(folder):
        processes = ProcessGroup(folder / "processes", cwd=PROJECT)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        at = ["--ros-args", "-r", "__ns:=/sim"]
        try:
            simulator = processes.start("pendulum_sim", "simulator", *at, "-p", "start:=top", "-p", "rate_hz:=100.0")
            processes.start("pendulum_lqr", "controller", *at, "-p", "period:=0.01")
            processes.start("pendulum_lqr", "disturbance", *at)
            console = processes.start(
                "pendulum_console", "console", "--port", port, "--runs", folder / "runs", alone=True
            )
            console.wait_for_output(r"console at http://localhost", 60)
            yield Bench(processes, simulator, f"http://localhost:{port}/", folder / "runs")
        finally:
            leftovers = processes.close()
    if leftovers:
        pytest.fail("processes that did not end by themselves: " + "; ".join(leftovers))


@pytest.fixture
def browser(bench: Bench, chromium: Any) -> Iterator[Any]:
    """Return Chromium for the pages of one test."""
    yield chromium
    for context in chromium.contexts:
        context.close()


def _open(browser: Any, address: str, width: int = 1280, height: int = 860, **options: Any) -> Any:
    page = browser.new_page(viewport={"width": width, "height": height}, **options)
    page.set_default_timeout(60_000)
    page.add_init_script(SLOW_DISPLAY)
    page.goto(address)
    page.wait_for_selector("[data-plant='/sim'] .armed_effort")
    return page


def _compare(folder: Path) -> None:
    """Write the summary of a run that was compared."""
    answer = sum_up([LayerResult(Layer.SAME_RUN, Mark.NO, "It answers 9 ms later.", [])])
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text(json.dumps({"answer": answer.to_json()}), encoding="utf-8")


def _mode(page: Any) -> str:
    return str(page.evaluate("(pendulumConsole.plants['/sim'] || {}).mode"))


def test_two_clients_see_stop_tune_and_meet_a_new_simulator(browser: Any, bench: Bench) -> None:
    desk, phone = _open(browser, bench.address), _open(browser, bench.address, 390, 844)

    # Phone: nothing hangs over the edge, and the stop is in reach.
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    box = phone.locator("#e_stop").bounding_box()
    assert box["y"] + box["height"] <= 844
    assert box["width"] > 300
    popup = phone.locator("#popup").bounding_box()  # says that the connection is lost; it has its place before that
    assert popup["y"] + popup["height"] <= box["y"], (popup, box)

    # Fingers need 44 px (WCAG 2.5.5); the keyboard's place is seen.
    small = "[...document.querySelectorAll('.card .q-btn')].filter((b) => b.offsetHeight && b.offsetHeight < 44).length"
    assert phone.evaluate(small) == 0
    arm = desk.get_by_role("button", name="Arm /sim", exact=True)
    arm.focus()
    desk.keyboard.press("Shift+Tab")
    desk.keyboard.press("Tab")
    seen = "(it) => [document.activeElement === it, getComputedStyle(it).boxShadow.includes('5px')]"
    assert arm.evaluate(seen) == [True, True]
    desk.get_by_role("button", name="Add to each plant").click()
    desk.locator(".notices", has_text="each plant has a disturbance already").wait_for(timeout=10_000)

    # A refused value is explained, and the value in force comes back.
    field = desk.locator("input[aria-label='r of /sim']")
    wait_for(lambda: field.input_value() == "0.1", 20, "the value in force")
    field.fill("-1")
    field.press("Tab")
    notice = desk.locator(".notices .bad", has_text="refuses r")
    notice.wait_for(timeout=10_000)
    assert "-1" in notice.inner_text()
    wait_for(lambda: field.input_value() == "0.1", 10, "the old value")
    on_the_phone = phone.locator("input[aria-label='r of /sim']")
    on_the_phone.fill("-1")
    on_the_phone.press("Tab")
    phone.locator(".notices .bad", has_text="refuses r").wait_for(timeout=10_000)
    for page in (desk, phone):
        # The bar stays on top, so whatever is scrolled lies under it.
        page.evaluate("window.scrollTo(0, 0)")
        assert page.evaluate(COVERED_BY_NOTICES) == []

    # So it does after a field was emptied, or holds more than a parameter can.
    seed = desk.locator("input[aria-label='seed of /sim']")
    for emptied_or_overflowing in ("", "9" * 30):
        seed.fill(emptied_or_overflowing)
        seed.press("Tab")
        wait_for(lambda: seed.input_value() == "1", 10, f"the old value after {emptied_or_overflowing!r}")
    desk.locator(".notices .bad", has_text="is too large; expected a whole number").wait_for(timeout=10_000)

    # From the key to the plant, on one clock; the best of some, since neighbours on the machine are not our delay.
    delays: list[float] = []
    desk.get_by_role("heading", name="Pendulum console").click()  # out of the field, which takes a space as text
    for _ in range(15):
        if len(delays) >= 5 and min(delays) <= STOP_LIMIT_MS:
            break
        before = desk.evaluate("pendulumConsole.stopPressed")
        desk.keyboard.press("Space")
        told = f"pendulumConsole.stopPressed > {before} && pendulumConsole.plants['/sim'].mode === 'e_stop'"
        wait_for(partial(desk.evaluate, told), 20, "the e-stop")
        # A repetition of the stop before may have come after its reset: then the plant stood still before this key.
        delay = float(desk.evaluate("pendulumConsole.plants['/sim'].mode_ms - pendulumConsole.stopPressed"))
        delays += [delay] if delay >= 0.0 else []
        wait_for(lambda: _mode(phone) == "e_stop", 30, "the other client to see it")
        desk.get_by_role("button", name="Reset e-stop /sim").click()
        wait_for(lambda: _mode(desk) == "disarmed", 10, "the reset")
    assert min(delays) <= STOP_LIMIT_MS, delays
    desk.get_by_role("button", name="Arm /sim", exact=True).click()
    wait_for(lambda: _mode(desk) == "armed_effort", 10, "the plant to be armed")

    # The node is killed: it is no longer shown as armed, and does not go without a word.
    bench.simulator.send_signal(signal.SIGKILL)
    row = desk.locator("[data-plant='/sim']")
    row.locator(".silent").wait_for(timeout=10_000)
    assert "no state for" in row.inner_text()
    wait_for(lambda: desk.evaluate("Object.keys(pendulumConsole.plants).length") == 0, 30, "the plant to be gone")
    gone = "/sim is gone from the graph (its last state: ARMED: follows the controller)"
    desk.locator("#alarms .note", has_text=gone).wait_for(timeout=10_000)

    # It comes back; the page goes on with the new one.
    at = ["--ros-args", "-r", "__ns:=/sim"]
    bench.processes.start("pendulum_sim", "simulator", *at, "-p", "start:=top", "-p", "rate_hz:=100.0")
    wait_for(lambda: _mode(desk) == "armed_effort", 60, "the new plant")
    before = desk.evaluate("pendulumConsole.plants['/sim'].stamp_ns")
    wait_for(lambda: desk.evaluate("pendulumConsole.plants['/sim'].stamp_ns") != before, 10, "new states")


def test_a_controller_that_the_page_started_ends_with_the_console_where_it_survived_all_but_ctrl_c(
    chromium: Any, domain_id: int, tmp_path: Path
) -> None:
    processes = ProcessGroup(tmp_path / "processes", cwd=PROJECT)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    try:
        processes.start("pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim", "-p", "rate_hz:=100.0")
        console = processes.start(
            "pendulum_console", "console", "--port", port, "--runs", tmp_path / "runs", alone=True
        )
        address = console.wait_for_output(r"console at (\S+)", 60)[1]
        page = _open(chromium, address)
        page.get_by_role("button", name="Start controller /sim").click()
        page.locator("[data-card='/sim']").get_by_text("lqr: inactive").wait_for()
        page.close()
        assert processes.leftovers()
        console.send_signal(signal.SIGTERM)
        console.wait(60)
        wait_for(lambda: not processes.leftovers(), 60, "the end of the controller")
    finally:
        left = processes.close()
    assert left == []


def test_joints_and_controllers_are_chosen_for_each_plant(browser: Any, bench: Bench) -> None:
    page = _open(browser, bench.address)
    acrobot = ["-p", "plant:=acrobot", "-p", "rate_hz:=100.0"]
    of_sim = page.get_by_role("button", name="Start controller /sim")
    place = of_sim.evaluate(PLACE_AMONG_PLANTS)
    other = bench.processes.start("pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/robot", *acrobot)
    joints = page.get_by_label("Lines of /robot: joint")
    joints.wait_for()
    assert joints.locator("option").all_inner_texts() == ["shoulder", "elbow"]
    shown = "[pendulumConsole.plants['/robot'].goal, pendulumConsole.plants['/sim'].goal]"
    assert page.evaluate(shown) == [math.pi, math.pi]
    joints.select_option("elbow")
    wait_for(lambda: page.evaluate(shown) == [0.0, math.pi], 60, "the elbow's values")

    # A plant that comes moves no button: it would be pressed in the place of another.
    robot = page.locator("[data-card='/robot']")
    robot.wait_for()
    assert of_sim.evaluate(PLACE_AMONG_PLANTS) == place

    # What runs already is not doubled.
    of_sim.click()
    already = re.compile(r"/sim/controller \(.+\) is there already")
    page.locator(".notices .bad", has_text=already).wait_for()

    # A plant of several joints is offered what can hold it; what is started waits until it is activated.
    robot.get_by_role("combobox").click()
    fitting = ["lqr", "lqi", "lqg", "discrete_lqr", "energy_swing_up", "tvlqr", "ilqr", "mpc", "nmpc"]
    wait_for(lambda: page.locator(".q-menu [role=option]").all_inner_texts() == fitting, 60, "the controllers")
    page.locator(".q-menu [role=option]").first.click()
    page.get_by_role("button", name="Start controller /robot").click()
    robot.get_by_text("lqr: inactive").wait_for()
    weights = page.locator("input[aria-label='q of /robot']")
    wait_for(lambda: weights.input_value() == "10, 10, 1, 1", 60, "its own parameters")
    page.get_by_role("button", name="Activate controller /robot", exact=True).click()
    robot.get_by_text("lqr: answering").wait_for()
    page.get_by_role("button", name="Deactivate controller /robot", exact=True).click()
    robot.get_by_text("lqr: inactive").wait_for()
    page.get_by_role("button", name="End controller /robot", exact=True).click()
    robot.get_by_text("no controller").wait_for()
    weights.wait_for(state="detached")

    # One that has gone keeps its place, and can be stopped should it come back.
    other.interrupt()
    assert other.wait(20) == 0
    page.get_by_role("button", name="Arm /robot", exact=True).wait_for(state="hidden")
    assert page.get_by_role("button", name="Stop /robot", exact=True).is_visible()
    assert robot.get_by_role("heading").is_visible()
    assert of_sim.evaluate(PLACE_AMONG_PLANTS) == place
    bench.processes.start("pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/robot", *acrobot)
    page.get_by_role("button", name="Arm /robot", exact=True).wait_for()


def test_axe_finds_nothing_that_keeps_anybody_out(browser: Any, bench: Bench) -> None:
    install_packages(AXE, "axe-core")
    page = _open(browser, bench.address, color_scheme="light")
    _compare(bench.runs / "compared")
    page.get_by_text("1 same run: ✗ no").wait_for(timeout=10_000)
    assert page.get_by_text("It answers 9 ms later.", exact=True).is_visible()
    page.wait_for_selector("[data-name='r']", timeout=30_000)
    page.keyboard.press("Escape")
    page.wait_for_selector("#alarms .good", timeout=10_000)
    tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]
    # As while somebody uses it: requests are under way.
    page.evaluate("setInterval(() => { const r = new XMLHttpRequest(); r.open('GET', '/'); r.send() }, 200)")
    page.wait_for_timeout(1000)
    problems = []
    backgrounds = {}
    cut = "[...document.querySelectorAll('.parameters')].filter(it => it.scrollWidth > it.clientWidth).length"
    # Colours do not depend on the width, nor the layout on the colours.
    for scheme, width in (("light", 1280), ("dark", 390)):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 844})
        # Each time: a page whose server has kept it waiting is loaded anew.
        page.add_script_tag(path=str(AXE / "node_modules" / "axe-core" / "axe.min.js"))
        found = page.evaluate("(tags) => axe.run(document, {runOnly: tags})", tags)
        assert page.evaluate(cut) == 0, f"a table of parameters is cut at {width} px"
        assert len(found["passes"]) > 15, "axe looked at next to nothing"
        problems += [
            f"{scheme}, {width} px: {it['id']}: {node['html'][:120]} {node['failureSummary']}"
            for it in found["violations"]
            for node in it["nodes"]
        ]
        backgrounds[scheme] = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert backgrounds["light"] != backgrounds["dark"], "the page did not change its colours"
    assert not problems, "\n".join(problems)


def test_a_foreign_page_cannot_press_the_button(bench: Bench) -> None:
    request = urllib.request.Request(bench.address + "e_stop", method="POST", headers={"Origin": "http://evil.example"})
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(request, timeout=10)
    assert caught.value.code == 403
    assert "another site" in caught.value.read().decode()
