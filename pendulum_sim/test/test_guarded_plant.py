"""What goes wrong with a simulation of others is a fault with a sentence."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.exports.model_files import mjcf
from pendulum_sim.foreign.guarded_plant import GuardedPlant, PaceWatch, StallWatch
from pendulum_sim.foreign.gymnasium_plant import load_gymnasium_plant
from pendulum_sim.foreign.mujoco_plant import load_mujoco_plant
from pendulum_sim.stepping.plant import PlantState, RigidPlant
from pendulum_sim.stepping.plants import JointPlant, OneJoint, make_plant


class Broken(RigidPlant):
    """A plant that does something odd in its next step."""

    odd: object = None

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        if isinstance(self.odd, BaseException):
            raise self.odd
        return PlantState(0.5, *self.odd)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("odd", "sentence"),
    [
        (ValueError("shapes\n (2,) and (3,)"), r"simulation lab failed in step: ValueError: shapes \(2,\) and \(3,\)"),
        (SystemExit("no licence"), "simulation lab failed in step: SystemExit: no licence"),
        (KeyError(), "simulation lab failed in step: KeyError"),
        (
            (math.nan, 0.0, 0.0),
            "simulation lab is at nan rad, 0.0 rad/s, 0.0 N m after 0.500 s; expected finite numbers",
        ),
        ((0.0, math.inf, 0.0), "is at 0.0 rad, inf rad/s"),
        (FaultError("it is gone"), "simulation lab: it is gone"),
    ],
)
def test_nothing_but_a_fault_gets_out(odd: object, sentence: str) -> None:
    plant = Broken(load_plant("thesis"), 0.002)
    plant.odd = odd
    with pytest.raises(FaultError, match=sentence):
        GuardedPlant(OneJoint(plant), "lab").step((0.0,), (0.0,))


def test_a_sound_plant_passes_unchanged() -> None:
    one, other = (make_plant(load_plant("thesis"), 0.002) for _ in range(2))
    guarded = GuardedPlant(one, "lab")
    assert guarded.reset((1.0,), (0.0,)) == other.reset((1.0,), (0.0,))
    assert guarded.step((0.3,), (0.1,)) == other.step((0.3,), (0.1,)) == guarded.state


def _mujoco(folder: Path) -> JointPlant:
    pytest.importorskip("mujoco")
    (folder / "lab.xml").write_text(mjcf(load_plant("thesis")), encoding="utf-8")
    return load_mujoco_plant(folder / "lab.xml")


_PLANTS: dict[str, Callable[[Path], JointPlant]] = {
    "rigid": lambda _: make_plant(load_plant("thesis"), 0.002),
    "series_elastic": lambda _: make_plant(load_plant("x5_9"), 0.002),
    "gymnasium": lambda _: OneJoint(load_gymnasium_plant("Pendulum-v1")),
    "mujoco": _mujoco,
}


@pytest.mark.parametrize("kind", _PLANTS)
def test_no_torque_is_made_of_a_command_that_is_no_number(kind: str, tmp_path: Path) -> None:
    plant = _PLANTS[kind](tmp_path)
    start = plant.reset((0.3,), (0.2,))
    for effort, push in ((math.nan, 0.0), (math.inf, 0.0), (0.0, math.nan), (0.0, -math.inf)):
        with pytest.raises(ParameterError, match=f"effort is {effort} N m and push {push} N m; expected finite"):
            plant.step((effort,), (push,))
        assert plant.state == start
    assert plant.step((0.0,), (0.0,)).time == pytest.approx(plant.dt)


def test_slow_steps_are_distinguished_from_one_pause() -> None:
    paused = PaceWatch(0.002)
    for _ in range(300):
        assert paused.problem(0.001, 0.0) == ""
    assert paused.problem(10.0, 10.0) == ""
    slow = PaceWatch(0.002)
    told = [slow.problem(0.005, 0.003 * i) for i in range(300)]
    assert not any(told[:167])
    assert "needs 4.8 ms for a period of 2 ms and is 0.5 s behind" in told[167]


def test_a_step_that_does_not_come_back_is_noticed_and_a_quick_one_is_not() -> None:
    stalled = threading.Event()
    watch = StallWatch(0.1, stalled.set)
    longest = 0.0
    for _ in range(100):
        began = time.monotonic()
        with watch:
            time.sleep(0.002)
        longest = max(longest, time.monotonic() - began)
    # On a busy machine one of them may have taken as long as none may.
    assert not stalled.is_set() or longest > 0.1
    stalled.clear()
    with StallWatch(0.1, stalled.set):
        assert stalled.wait(10.0)
    unused = StallWatch(0.1, stalled.clear)
    unused.close()
