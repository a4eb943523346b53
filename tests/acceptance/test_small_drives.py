"""The first day with a servo: the commands of its page, one after the other, on an emulated one."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup

PAGE = PROJECT / "pendulum_hw_bridge/docs/small_drives.md"


_BUSY = ("too busy", "host_stalled", "computer is busy", "feedback_lost", "Bus Watchdog", "does not answer")
"""What a pause of 0.1 s of the emulator or the bridge is reported as, rightly: with a real servo it ends the torque."""


@pytest.mark.timeout(400)
def test_the_commands_of_the_page_lead_to_a_verdict(processes: ProcessGroup, domain_id: int, tmp_path: Path) -> None:
    pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
    (block,) = re.findall(
        r"^<!-- drive -->\n```console\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    first, *others = [shlex.split(line.removeprefix("$ python ")) for line in block.splitlines()]
    emulator = processes.start(*first[1:], cwd=tmp_path, alone=True)
    emulator.wait_for_output(r"emulated dynamixel \(xl330\), number 1, on servo", 60)
    for words in others:
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
        said = done.stdout + done.stderr
        if done.returncode and any(sentence in said for sentence in _BUSY):
            pytest.skip(f"this computer is too busy for {words[:4]}: {said.splitlines()[-1]}")
        assert done.returncode == 0, f"{words}\n{said}"
        if "check" in words:
            # A servo has no motion stop.
            assert "Keep a hand on the switch of its supply" in " ".join(done.stdout.split())
        if "scan" in words:
            assert "The bridge would drive" in done.stdout
        if "new" in words:
            # Other programs use this computer too; still inside what a real machine may have.
            lab = tmp_path / "lab.yaml"
            slow = "drive:\n  feedback_watchdog: 10\n  command_lifetime: {value: 0.1, unit: s}\n"
            lab.write_text(lab.read_text(encoding="utf-8").replace("drive:\n", slow), encoding="utf-8")
    assert "Is the simulation good enough" in done.stdout
    emulator.interrupt()
    assert emulator.wait(30) == 0, emulator.output
