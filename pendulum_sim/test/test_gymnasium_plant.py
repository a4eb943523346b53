"""Environments of Gymnasium as plants: known ones, adapted ones, and what is refused."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.foreign.gymnasium_plant import GymnasiumPlant, load_adapter, load_gymnasium_plant
from pendulum_sim.simulator.engines import open_simulation
from pendulum_sim.stepping.plants import make_pendulum


class Lab(gymnasium.Env[Any, Any]):
    """A pendulum in degrees, turned round, upright at 90, with a torque of 3 N m for an action of 1."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, ends: float = math.inf) -> None:
        self.step_time = 0.002
        self.x = np.zeros(2)
        self._ends = ends

    def _observe(self) -> Any:
        return np.array([0.0, math.degrees(self.x[1]), (math.degrees(self.x[0]) + 180.0) % 360.0 - 180.0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        chosen = options or {"q": 0.0, "w": 0.0}
        self.x = np.radians([chosen["q"], chosen["w"]])
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        # q = pi / 2 is upright: q = 3 pi / 2 - theta.
        torque = 3.0 * action[1] + 2.0 * math.cos(self.x[0]) * -1.0
        self.x[1] += self.step_time * (torque - 0.4 * self.x[1]) / 0.1
        self.x[0] += self.step_time * self.x[1]
        return self._observe(), 0.0, bool(abs(self.x[1]) > self._ends), False, {}


gymnasium.register("Lab-v0", entry_point=Lab)
ADAPTER = {
    "angle": {"index": 2, "unit": "deg", "sign": -1, "zero": -90.0},
    "velocity": {"index": 1, "unit": "deg/s", "sign": -1},
    "torque": {"index": 1, "scale": 3.0, "sign": -1},
    "start": {"options": ["q", "w"]},
    "period": "step_time",
}


def run(plant: Any, theta: float, effort: float) -> list[float]:
    plant.reset(theta, 0.5)
    return [plant.step(effort).theta for _ in range(200)]


def test_our_own_environment_is_our_plant() -> None:
    plant = load_gymnasium_plant("PendulumX59-v0")
    ours = load_plant("thesis")
    for name in ("inertia", "damping", "gravity", "effort_limit"):
        assert getattr(plant.parameters, name) == pytest.approx(getattr(ours, name), rel=1e-4), name
    # An action has single precision.
    assert run(plant, 3.0, 5.0) == pytest.approx(run(make_pendulum(ours, 0.002), 3.0, 5.0), abs=1e-6)


def test_pendulum_v1_needs_no_adapter_and_hangs_at_our_zero() -> None:
    plant = load_gymnasium_plant("Pendulum-v1")
    assert (plant.dt, plant.parameters.effort_limit, plant.parameters.damping) == (0.05, 2.0, 0.0)
    assert plant.parameters.inertia == pytest.approx(1.0 / 3.0)
    assert plant.parameters.gravity == pytest.approx(5.0)
    assert run(plant, 0.0, 0.0)[0] > 0.0  # the start's velocity
    assert plant.reset(math.pi).theta == math.pi
    assert plant.step(0.0).theta == pytest.approx(math.pi)


def test_attributes_make_another_pendulum_of_it() -> None:
    plant = load_gymnasium_plant(
        "Pendulum-v1", {"make": {"g": 9.81}, "set": {"dt": 0.002, "max_torque": 13.0, "m": 0.5}}
    )
    assert (plant.dt, plant.parameters.effort_limit) == (0.002, 13.0)
    assert plant.parameters.gravity == pytest.approx(0.25 * 9.81)


def test_units_signs_and_entries_are_those_of_the_adapter() -> None:
    plant = load_gymnasium_plant("Lab-v0", ADAPTER)
    found = plant.parameters
    assert found.effort_limit == pytest.approx(3.0)
    assert (found.inertia, found.damping, found.gravity) == pytest.approx((0.1, 0.4, 2.0), rel=0.02)
    assert run(plant, 2.0, 1.5) == pytest.approx(run(make_pendulum(found, 0.002), 2.0, 1.5), abs=0.02)
    # The observation wraps at a right angle of ours, and our angle goes on.
    angles = run(plant, 1.2, 3.0)
    assert angles[-1] > 0.5 * math.pi
    assert np.max(np.abs(np.diff(angles))) < 0.1


def test_an_environment_that_ends_its_episode_is_a_fault() -> None:
    plant = load_gymnasium_plant("Lab-v0", {**ADAPTER, "make": {"ends": 6.0}})
    with pytest.raises(FaultError, match="ended its episode at"):
        [plant.step(3.0) for _ in range(1000)]


def test_a_push_acts_past_the_limit_of_commands() -> None:
    plant = load_gymnasium_plant("Pendulum-v1", {"effort_limit": {"value": 0.5, "unit": "N m"}})
    plant.reset(0.0)
    alone = plant.step(9.0)
    plant.reset(0.0)
    pushed = plant.step(9.0, 0.5)
    assert (alone.effort, pushed.effort) == (0.5, 0.5)
    assert pushed.theta_dot == pytest.approx(2.0 * alone.theta_dot)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"angle": None}, r"nothing says what is angle; expected an adapter file"),
        ({"angle": {"index": 7}}, r"angle and velocity are not where the adapter says"),
        ({"angle": {"index": 0, "unit": "turns"}}, r"angle: unit is 'turns'; expected rad or deg"),
        ({"torque": {"index": 2}}, r"torque.index is 2, an action has 2 entries"),
        ({"torque": {"index": 1, "scale": 3.0}}, r"a positive torque speeds it up backwards; expected torque.sign"),
        ({"torque": {"index": 1, "scale": 0}}, r"torque.scale is 0; expected a number, not 0"),
        ({"start": None}, r"nothing says how it starts at an angle"),
        ({"period": {"value": 2, "unit": "ms"}}, r"period: unit is 'ms'; expected 's'"),
        ({"period": "dt"}, r"it has no attribute 'dt'; expected period: \{value: ..., unit: s\}"),
        ({"set": {"mass": 1.0}}, r"set names 'mass', which the environment has not"),
        ({"make": {"friend": 1}}, r"Gymnasium refuses environment 'Lab-v0'"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    adapter = {key: value for key, value in {**ADAPTER, **changes}.items() if value is not None}
    with pytest.raises(ParameterError, match=sentence) as refused:
        load_gymnasium_plant("Lab-v0", adapter)
    assert "\n" not in str(refused.value)


class Bad(Lab):
    """The same, as others write it."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how = how

    def reset(self, **told: Any) -> Any:
        observation, more = super().reset(**told)
        return observation if self.how == "old reset" else (self._spoil(observation), more)

    def _spoil(self, observation: Any) -> Any:
        if self.how == "mapping":
            return {"angle": observation[2]}
        return observation[None] if self.how == "shape" else observation

    def step(self, action: Any) -> Any:
        observation, *others, more = super().step(action)
        if self.how == "raises":
            raise AssertionError("out of the\nworkspace")
        if self.how == "exits":
            sys.exit("no licence")
        if self.how == "nan":
            observation = observation * math.nan
        return (observation, *others[:2], more) if self.how == "old step" else (self._spoil(observation), *others, more)


gymnasium.register("Bad-v0", entry_point=Bad)


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ("old step", r"step returns 4 values; expected 5 values \(observation, .* as in Gymnasium 0.26 and later"),
        ("old reset", "reset returns a ndarray; expected observation and info, as in Gymnasium 0.26 and later"),
        ("raises", "environment Bad-v0 failed in loading: AssertionError: out of the workspace"),
        ("exits", "environment Bad-v0 failed in loading: SystemExit: no licence"),
        ("nan", "it is at nan rad, nan rad/s; expected finite numbers"),
        ("mapping", "its observation is a dict, expected an array that holds both"),
        ("shape", r"its observation is of shape \(1, 3\), expected an array that holds both"),
    ],
)
def test_what_foreign_code_does_is_one_sentence_and_no_traceback(tmp_path: Path, how: str, sentence: str) -> None:
    adapter = tmp_path / "adapter.yaml"
    adapter.write_text(json.dumps({"format": "pendulum_simulation/1", **ADAPTER, "make": {"how": how}}))
    with pytest.raises(ParameterError, match=sentence) as refused:
        open_simulation("gymnasium:Bad-v0", str(adapter))
    assert "\n" not in str(refused.value)


def test_an_adapter_file_is_read_and_its_mistakes_are_named(tmp_path: Path) -> None:
    path = tmp_path / "adapter.yaml"
    path.write_text("format: pendulum_simulation/1\nset: {dt: 0.002}\nequation: thesis\n", encoding="utf-8")
    plant = load_gymnasium_plant("Pendulum-v1", load_adapter(path))
    assert isinstance(plant, GymnasiumPlant)
    assert (plant.parameters.inertia, plant.parameters.effort_limit) == (0.055, 2.0)
    for text, sentence in (
        ("set: {dt: 0.002}", "format is missing or another"),
        ("format: pendulum_simulation/1\nangles: 3", "unknown parameter 'angles'; did you mean 'angle'"),
        ("format: pendulum_simulation/1\nangle: {entry: 3}", "angle: unknown parameter 'entry'"),
        ("format: pendulum_simulation/1\nangle: 3", "angle is a int"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ParameterError, match=sentence):
            load_adapter(path)
