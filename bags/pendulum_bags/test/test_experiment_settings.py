"""What an experiment starts fits the programs that it starts, whatever the controller."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import RAMP_SPEEDS, RegulationSettings
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_lqr.controller_interface.controller import COMMON_PARAMETERS, controller_names, controller_parameters
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.plant_specs import limits_from_parameters
from pendulum_msgs_py.contract.supervisor import PlantSupervisor
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_testing.policies import linear_policy

# Not those that need a file or a task of their own to be designed.
_NODE_OWN = {"controller", "plant", "use_sim_time"}


@pytest.mark.parametrize("kind", controller_names())
def test_every_controller_is_started_with_parameters_that_it_has(kind: str, tmp_path: Path) -> None:
    if kind == "policy":
        with pytest.raises(ParameterError, match=r"controller is 'policy' without a file; expected .*\.npz"):
            RegulationSettings(controller=kind)
        policy = write_policy(tmp_path / "policy.npz", linear_policy(load_plant("thesis"), 20.0, 1.0))
    settings = RegulationSettings(controller=str(policy) if kind == "policy" else kind)
    given = settings.controller_program("/sim").parameters
    own = {name: value for name, value in given.items() if name not in _NODE_OWN}
    specs = {spec.name: spec for spec in (*COMMON_PARAMETERS, *controller_parameters(kind))}
    checked = validate(specs.values(), own, where=kind)
    # And with the weights of the experiment where it has weights, as its bag will say.
    for name, value in {"q": [100.0, 0.01], "r": 0.1}.items():
        assert (name in own) == (name in specs)
        assert checked.get(name, value) == value
    run = settings.metadata("thesis")["pendulum.run"]
    assert run["controller"] == {"kind": kind, **own}


@pytest.mark.parametrize(("name", "value"), [("q", (1.0, 0.01)), ("r", 2.0)])
def test_weights_for_a_controller_without_them_are_refused_not_ignored(name: str, value: object) -> None:
    with pytest.raises(ParameterError, match=f"{name} is .* for controller 'pd_gravity', which has no such parameter"):
        RegulationSettings(controller="pd_gravity", **{name: value})  # type: ignore[arg-type]
    RegulationSettings(controller="lqi", **{name: value})  # type: ignore[arg-type]


def test_a_plant_with_motor_and_spring_is_not_stepped_by_the_thesis_s_integrator() -> None:
    # Its simulator refused to start: the plant of the emulated actuator could not be simulated beside it.
    assert RegulationSettings().method == RunSpec().method == "euler"
    for settings in (RegulationSettings(plant="x5_9"), RunSpec(plant="x5_9")):
        assert make_pendulum(load_plant("x5_9"), 0.002, method=settings.method).state.theta == 0.0


def test_ramps_are_the_thesis_s_by_default_and_on_request_slower_or_faster_in_all_that_they_are() -> None:
    usual = RegulationSettings()
    assert usual.ramp(0.1, UPRIGHT) == thesis_ramp(0.1, UPRIGHT)
    assert usual.expected_wall_time == 47.0 + 5.0
    for speed in (0.05, 0.6, 0.8):
        told = RegulationSettings(ramp_speed=speed)
        ramp = told.ramp(0.0, UPRIGHT)
        assert ramp.duration == pytest.approx(UPRIGHT / speed, abs=0.01) == pytest.approx(told.ramp_time, abs=0.01)
        assert max(point.velocity for point in ramp.points) == pytest.approx(1.5 * speed, rel=1e-3)
        assert told.expected_wall_time == pytest.approx(52.0 - 10.0 * math.pi + 2.0 * told.ramp_time)
    for speed in (0.0, 0.049, 0.81, math.nan):
        with pytest.raises(ParameterError, match=r"ramp speed is .* rad/s; expected 0.05 to 0.8"):
            RegulationSettings(ramp_speed=speed)


def test_the_fastest_ramp_is_one_that_a_bridge_with_its_usual_limit_follows_from_where_the_pendulum_stands() -> None:
    # The ramp down was refused, with the pendulum upright.
    limits = limits_from_parameters(
        {spec.name: spec.default for spec in SPECS}, (13.0,), lockstep=True, feedback_timeout=0.1
    )
    for gap in (-0.29, -0.001, 0.001, 0.29):
        plant = PlantSupervisor(limits)
        sample = JointSample.of_one(0, UPRIGHT, 0.0, 0.0)
        assert plant.arm(0, sample) == ""
        ramp = RegulationSettings(ramp_speed=RAMP_SPEEDS[1]).ramp(UPRIGHT + gap, 0.0)
        assert plant.accept_trajectory(ramp, 0, sample) == ""


@pytest.mark.parametrize("value", [math.nan, [-1.0, math.inf]])
def test_a_parameter_of_the_plant_that_is_no_number_is_refused_before_anything_is_written(value: object) -> None:
    # A study ended in a traceback of the JSON library, with half a folder behind it.
    with pytest.raises(ParameterError, match=r"parameter limit of the plant is (nan|inf); expected a finite number"):
        RunSpec(plant_parameters={"limit": value})
