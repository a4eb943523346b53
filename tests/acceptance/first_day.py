"""A first day in a lab, whole: every command as a person types it, with the backend ``hebi`` and emulated modules.

``python -m tests.acceptance.first_day`` lives through it and writes what was said into the page of the first day;
``test_first_day.py`` lives through it too, and compares.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_msgs_py.plants.lab_file import load_lab, write_lab
from pendulum_testing.fixtures import PROJECT, wait_for
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.acceptance.first_day_bench import PATIENCE, TRIES, Button, Day
from tests.acceptance.first_day_page import PAGE, Step, text_of, write_page

__all__ = ["live_through"]


def live_through(day: Day, *, whole: bool = True) -> list[Step]:
    """Live through the day; every expectation is asserted on what the emulated machine itself says.

    Args:
        day: The bench.
        whole: With the procedures that wait for a pendulum to come to rest, and with what `check` refuses.
    """
    _get_to_know(day, whole=whole)
    if whole:
        _find_zero(day)
    _prove_m_stop(day)
    if whole:
        _prove_lifetime(day)
    _set_up_button(day)
    if whole:
        _refuse(day)
    _check(day)
    _drive(day)
    _leave(day)
    return day.steps


def _get_to_know(day: Day, *, whole: bool) -> None:
    hw = "pendulum_hw_bridge"
    day.run(
        f"{hw} scan --interface {day.network}",
        heading="Who is there",
        words="Two modules on the network have the same name. `scan` changes no setting. It refuses to choose "
        "between two modules of one name (exit code 1), and refuses a module of another type.",
        code=1,
    )
    if whole:
        day.run(f"{hw} scan --interface {day.network} --serial X5-4-00077", code=1, keep="type of")
    day.run(f"{hw} scan --interface {day.network} --serial X5-9-00123", keep="->|drive")
    day.run(
        f"{hw} lab new lab.yaml --interface {day.network} --serial X5-9-00123 --effort 1",
        heading="The lab file",
        words="The file is for this one module, with 1 N m as the largest torque for today. The backup keeps "
        "the module's earlier settings in HEBI's own files.",
    )
    day.run(f"{hw} lab backup lab.yaml --out before_us")
    assert "<max_limit>inf" in (day.folder / "before_us" / "safety.xml").read_text()


def _find_zero(day: Day) -> None:
    hw, lab = "pendulum_hw_bridge", day.folder / "lab.yaml"
    day.run(f"{hw} lab zero lab.yaml", heading="Zero, sign and tare, without torque", person=_zero(day))
    assert load_lab(lab).values["joint_sign"] == 1
    assert abs(load_lab(lab).values["joint_offset"]) < 0.05
    day.run(f"{hw} lab tare lab.yaml", person=day.agrees)
    assert abs(load_lab(lab).values["effort_tare"]) < 0.1


def _zero(day: Day) -> Callable[[RunningProgram], object]:
    def act(program: RunningProgram) -> None:
        day.agrees(program)
        day.turns(program, " COUNTER-CLOCKWISE")
        day.turns(program, " CLOCKWISE", clockwise=True, seen=2)

    return act


def _prove_m_stop(day: Day) -> None:
    day.run(
        "pendulum_hw_bridge lab prove_m_stop lab.yaml",
        heading="Two proofs: motion stop and command lifetime",
        words="In both, the motor turns gently, for the first time.",
        person=day.presses_the_motion_stop,
    )
    assert day.truth.status()["strategy"] == Strategy.OFF


def _prove_lifetime(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    expiries = day.truth.status()["lifetime_expiries"]
    day.run(f"{hw} lab prove_lifetime lab.yaml", person=day.agrees)
    assert day.truth.status()["lifetime_expiries"] > expiries
    day.run(f"{hw} lab show lab.yaml", keep="Proved|_stop|lifetime|tare|zero")


def _set_up_button(day: Day) -> None:
    # What is set now is the lab's own: patience with a computer that others use too, and a button.
    lab = load_lab(day.folder / "lab.yaml")
    write_lab(day.folder / "lab.yaml", lab.changed(feedback_watchdog=10, e_stop_input_timeout=1.0))


def _refuse(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    wrong = "NO|^[a-z].*: |eady"
    day.run(
        f"{hw} check --lab lab.yaml --joint-offset 3.1 --no-nudge",
        heading="What check refuses",
        words="`check` refuses a wrong zero, a wrong sign (the nudge shows it), and a torque at rest that "
        "nothing explains, here from a sensor that has slipped (exit code 1 each).",
        code=1,
        keep=wrong,
    )
    day.run(
        f"{hw} check --lab lab.yaml --joint-sign -1",
        code=1,
        keep=wrong,
        person=lambda program: day.turns(program, " COUNTER-CLOCKWISE"),
    )
    day.truth.inject("effort_offset")
    day.run(f"{hw} check --lab lab.yaml --no-nudge", code=1, keep=wrong)
    day.truth.clear_faults()


def _check(day: Day) -> None:
    day.run(
        "pendulum_hw_bridge check --lab lab.yaml",
        heading="Check",
        words="The lab file is the same, except for two values that were set by hand before: "
        "`e_stop_input_timeout` 1 s, for the button below, and `feedback_watchdog` 10 periods instead of "
        "3, because other programs use this computer too. You turn the link counter-clockwise when asked "
        "to.",
        person=lambda program: day.turns(program, " COUNTER-CLOCKWISE"),
    )


def _drive(day: Day) -> None:
    bags = "pendulum_bags move"
    with _bridge(day) as (bridge, button):
        day.run(
            f"{bags} 0.3 --namespace /hw",
            heading="A ramp at 1 N m, hold, e-stop",
            words="These commands run in a second terminal. The bridge runs in the first one all the time; its "
            "output is below. The e-stop ends the first ramp (by its service, as the console calls it); "
            "the second ramp is completed and held.",
            code=2,
            person=lambda program: _stops_in_the_ramp(day, button, program),
            said="e.stop",
        )
        day.run(f"{bags} reset --namespace /hw")
        _hold(day, f"{bags} 0.3 --namespace /hw", 0.3)
        day.run(f"{bags} stop --namespace /hw")
        _is_off(day)

        day.run(
            f"{bags} reset --namespace /hw",
            heading="A button as e-stop",
            words="The lab file has `e_stop_input_timeout: 1 s`, and a button reports 20 times a second that it "
            "is not pressed. Somebody presses it while the motor holds. Later it falls silent, as if its "
            "cable were pulled out.",
        )
        for goal, pressed, told in ((0.4, True, "button is pressed"), (-0.2, None, "is silent for")):
            _hold(day, f"{bags} {goal} --namespace /hw", goal)
            before = len(re.findall(told, bridge.output))
            button.pressed = pressed
            _is_off(day)
            wait_for(lambda b=before, t=told: len(re.findall(t, bridge.output)) > b, PATIENCE, told)  # type: ignore[misc]
            button.pressed = False
            day.run(f"{bags} reset --namespace /hw")
        day.run(f"{bags} down --namespace /hw")
        _is_off(day)
        bridge.send_signal(signal.SIGINT)
        assert bridge.wait(30.0) == 0, bridge.output
        said = "".join(line for line in bridge.output.splitlines(keepends=True) if "[" in line)
        words = "This is the bridge's output in its terminal during all of this, until Ctrl-C."
        command = "python -m pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p lab_file:=lab.yaml"
        day.steps.append(Step("The bridge", words, command, day.tidy(said), 0))
    assert day.truth.status()["strategy"] == Strategy.OFF


@contextlib.contextmanager
def _bridge(day: Day) -> Iterator[tuple[RunningProgram, Button]]:
    button = Button(day.domain)
    try:
        bridge = day.start("pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p lab_file:=lab.yaml")
        bridge.wait_for_output("ready", PATIENCE)
        day.resets()
        yield bridge, button
    finally:
        button.close()


def _hold(day: Day, command: str, angle: float) -> None:
    """Move there, and see that the motor holds it; a computer that is too busy meanwhile is given further tries."""
    for _ in range(TRIES):
        step = day.run(command)
        status = day.truth.status()
        if status["strategy"] != Strategy.OFF:
            assert abs(status["link"]["position"] - angle) < 0.12, status["link"]
            return
        day.steps.remove(step)
        day.resets()
    raise AssertionError(f"{command}: not held after {TRIES} tries")


def _stops_in_the_ramp(day: Day, button: Button, program: RunningProgram) -> None:
    program.wait_for_output("moving from", PATIENCE)
    day.until(lambda status: status["link"]["position"] > 0.08 or program.returncode is not None, "the ramp to rise")
    button.e_stop()
    program.wait(PATIENCE)
    _is_off(day)


def _is_off(day: Day) -> None:
    # The motor's own record is of the physics' last step, a little before the strategy's.
    day.until(lambda status: status["strategy"] == Strategy.OFF and status["link"]["pwm"] == 0.0, "no torque")


def _leave(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    day.run(
        f"{hw} lab restore lab.yaml before_us",
        heading="Give the module back as it was",
        words="This restores gains, limits and M-stop action; the second backup shows that they are those of "
        "the first.",
        person=day.agrees,
    )
    day.run(f"{hw} lab backup lab.yaml --out after_us")
    for name in ("gains.xml", "safety.xml", "position_limit_strategies.json"):
        assert (day.folder / "after_us" / name).read_text() == (day.folder / "before_us" / name).read_text()


def main() -> None:
    """Live through the day and write the page."""
    with tempfile.TemporaryDirectory(prefix="pendulum_day_") as name, reserve_domain() as domain:
        folder = Path(name, "lab")
        folder.mkdir()
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        processes = ProcessGroup(Path(name, "processes"), cwd=PROJECT)
        day = Day(processes, folder, domain)
        try:
            write_page(live_through(day))
            print(f"{PAGE}: {len(day.steps)} commands")
        except BaseException:
            print(text_of(day.steps))  # what was said until then
            raise
        finally:
            day.close()
            processes.close()


if __name__ == "__main__":
    main()
