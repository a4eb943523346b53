"""Plant and controller on two machines, and a cable pulled; ``python -m tests.tools.faults.network`` also for 30 s.

``python -m tests.tools.faults.delay_margin`` delays that cable until the pendulum falls.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pendulum_lqr.linear.design import continuous_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_sim.stepping.plants import make_pendulum
from tests.tools.faults.bag_property import COMMAND_LIFE, check_bag
from tests.tools.faults.delay_margin import LIGHT, PERIOD, Q, R, predicted_margin
from tests.tools.faults.network import PLANT_ADDRESS, cut_cable, two_machines, why_not
from tests.tools.faults.slow_cable import SlowCable

_MACHINE_PATIENCE = 0.060


def test_a_pulled_cable_ends_the_torque_and_a_plugged_one_brings_it_back(tmp_path: Path) -> None:
    reason = why_not()
    if reason:
        pytest.skip(reason)
    (report,) = cut_cable(tmp_path, [1.0])
    assert report.time_to_zero <= COMMAND_LIFE + _MACHINE_PATIENCE
    assert report.largest <= 5.0
    (record,) = check_bag(tmp_path / "bag", limit=5.0, allowance=_MACHINE_PATIENCE)
    assert record.violations == ()


_ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("", 5005))
print("ready", flush=True)
while True:
    text, sender = s.recvfrom(2000)
    s.sendto(text, sender)
"""
_ASK = f"""
import socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.settimeout(float(sys.argv[1]))
times, lost = [], 0
for _ in range(40):
    began = time.monotonic()
    s.sendto(b"x", ("{PLANT_ADDRESS}", 5005))
    try:
        s.recv(100)
        times.append(time.monotonic() - began)
    except TimeoutError:
        lost += 1
print(min(times), lost)
"""


def test_cable_delays_and_loses_as_configured() -> None:
    reason = why_not()
    if reason:
        pytest.skip(reason)
    with two_machines(slow=True) as (plant, other, cable):
        assert isinstance(cable, SlowCable)
        echo = subprocess.Popen(
            ["ip", "netns", "exec", plant, sys.executable, "-c", _ECHO], stdout=subprocess.PIPE, text=True
        )
        try:
            assert echo.stdout is not None
            assert echo.stdout.readline() == "ready\n"
            quick, lost = _ask(other)
            assert (quick < 0.008, lost) == (True, 0)
            cable.set(0.010)
            slow, lost = _ask(other)
            # Nobody is faster than the cable; how much slower is a question of the machine.
            assert slow >= 0.020
            assert lost == 0
            cable.set(0.0, 0.3)
            assert 5 <= _ask(other, patience=0.05)[1] <= 35
        finally:
            echo.kill()
            echo.wait(10.0)
            if echo.stdout is not None:
                echo.stdout.close()


def _ask(namespace: str, *, patience: float = 5.0) -> tuple[float, int]:
    done = subprocess.run(
        ["ip", "netns", "exec", namespace, sys.executable, "-c", _ASK, str(patience)],
        capture_output=True,
        text=True,
        timeout=40,
        check=True,
    )
    fastest, lost = done.stdout.split()
    return float(fastest), int(lost)


def test_predicted_margin_is_where_the_simulated_loop_turns_unstable() -> None:
    predicted, continuous = predicted_margin()
    assert 0.0 < continuous - predicted < PERIOD
    K = continuous_lqr(linearise(LIGHT), Q, R).K
    ends = []
    for delay in (0.93 * predicted, 1.07 * predicted):
        plant = make_pendulum(LIGHT.with_values(transport_delay=delay), PERIOD, method="etd4")
        state = plant.reset(UPRIGHT + 1e-4, 0.0)
        for _ in range(2000):
            state = plant.step(-float(K[0] * (state.theta - UPRIGHT) + K[1] * state.theta_dot))
        ends.append(abs(state.theta - UPRIGHT))
    assert ends[0] < 1e-4
    assert ends[1] > 1e-2


@pytest.mark.parametrize("side", ["sim", "hw"])
def test_recorded_examples_keep_the_rule_of_the_last_command(side: str) -> None:
    example = Path(__file__).parents[2] / "bags" / "examples" / f"regulation_{side}"
    (record,) = check_bag(example, limit=13.0)
    assert record.samples > 100
    assert record.violations == ()
