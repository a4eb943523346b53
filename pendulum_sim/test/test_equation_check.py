"""A simulation of others is run against its equation: what differs is found, and named only where it is the cause."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import (
    PlantParameters,
    load_mechanism,
    load_plant,
    pendulum_plant,
    write_plant,
)
from pendulum_sim.exports.model_files import mjcf
from pendulum_sim.foreign.equation_check import TOLERANCE, EquationCheck, check_equation
from pendulum_sim.simulator.engines import open_simulation
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_sim.stepping.plants import make_plant

pytest.importorskip("mujoco")

# --- MuJoCo ----------------------------------------------------------------------------------------------------

AGREES = ""
FEATURES: dict[str, str] = {
    "plain": AGREES,
    "range": "the range of a joint",
    "contact": "contact",
    "gravcomp": AGREES,
    "fluid": "the fluid around it",
    "tendon": "a tendon",
    "spring": "a spring",
    "polynomial": "polynomial damping",
    "motor_polynomial": "polynomial damping",
    "motor_damping": AGREES,
    "motor_delay": AGREES,
    "motor_armature": AGREES,
    "motor_lag": AGREES,
    "equality": "an equality constraint",
    "elbow": "other joints that move",
    "free_body": AGREES,
    "servo_too": "other actuators",
    "flag": "a flag that disables a part of MuJoCo",
}
"""What a model has besides a plain pendulum, and the cause that is to be named; nothing where its equation holds."""


def write_model(path: Path, feature: str) -> Path:
    """Write a random pendulum with one feature, which is strong enough to matter."""
    draw = random.Random(f"{feature} 1")
    length, mass = draw.uniform(0.1, 0.8), 10.0 ** draw.uniform(-1.0, 0.7)
    weight, inertia = 9.81 * mass * length, 1.05 * mass * length**2
    rate = math.sqrt(weight / inertia)
    damping = 10.0 ** draw.uniform(-2.5, 0.5) * inertia * rate
    friction, gear = draw.choice([0.0, 0.0, 0.03, 0.1]) * weight, draw.choice([1.0, 2.0, 0.5])
    limit = 10.0 ** draw.uniform(-0.3, 1.0) * weight
    timestep = draw.choice([0.002, 0.002, 0.005, 0.005])
    integrator = draw.choice(["Euler", "implicitfast", "RK4", "implicit"])
    up = draw.choice([1, -1])
    damped, joint, body, option = f'damping="{damping}"', "", "", ""
    flag = world = inner = more = others = ""
    motor, kind = f'gear="{gear}" ctrlrange="{-limit / gear} {limit / gear}"', "motor"
    if feature == "range":
        joint = f'range="-{draw.uniform(60.0, 179.0)} {draw.uniform(60.0, 179.0)}"'
    elif feature == "contact":
        angle = draw.uniform(-math.pi, math.pi)
        place = f"{length * math.sin(angle)} 0 {1.0 + length * math.cos(angle)}"
        world = f'<geom type="sphere" size="{0.2 * length}" pos="{place}"/>'
    elif feature == "gravcomp":
        body = f'gravcomp="{draw.uniform(0.3, 1.2)}"'
    elif feature == "fluid":
        option = f'density="{draw.uniform(500.0, 2000.0)}" viscosity="0.1"'
    elif feature == "tendon":
        spring = draw.uniform(0.3, 3.0) * weight
        more = f'<tendon><fixed stiffness="{spring}"><joint joint="hinge" coef="1"/></fixed></tendon>'
    elif feature == "spring":
        joint = f'stiffness="{draw.uniform(0.3, 3.0) * weight}" springref="{draw.uniform(-90.0, 90.0)}"'
    elif feature == "polynomial":
        damped = f'damping="{damping} {draw.uniform(0.5, 3.0) * inertia}"'
    elif feature == "motor_polynomial":
        motor += f' damping="0 {draw.uniform(0.5, 3.0) * inertia / gear**3}"'
    elif feature == "motor_damping":
        motor += f' damping="{draw.uniform(0.3, 3.0) * inertia * rate / gear**2}"'
    elif feature == "motor_delay":
        steps = draw.randint(2, 10)
        motor += f' delay="{steps * timestep}" nsample="{steps + 1}"'
    elif feature == "motor_armature":
        motor += f' armature="{draw.uniform(0.1, 2.0) * inertia / gear**2}"'
    elif feature == "motor_lag":
        kind, motor = "general", motor + f' dyntype="filterexact" dynprm="{draw.uniform(0.005, 0.1)}"'
    elif feature == "equality":
        world = f'<body pos="0 0 2"><joint name="other"/><geom size="0.05" mass="{mass}" pos="0.1 0 0"/></body>'
        more = '<equality><joint joint1="hinge" joint2="other"/></equality>'
    elif feature == "elbow":
        inner = f'<body pos="0 0 {up * length}"><joint name="elbow" axis="0 1 0" damping="{0.1 * damping}"/>'
        inner += f'<geom size="0.02" mass="{draw.uniform(0.3, 1.0) * mass}" pos="0 0 {0.5 * up * length}"/></body>'
    elif feature == "free_body":
        world = '<body pos="3 0 3"><freejoint/><geom size="0.1"/></body>'
    elif feature == "servo_too":
        others = f'<position joint="hinge" kp="{draw.uniform(0.3, 3.0) * weight}"/>'
    elif feature == "flag":
        flag, friction = '<flag frictionloss="disable"/>', 0.2 * weight
    path.write_text(
        f'<mujoco><option timestep="{timestep}" integrator="{integrator}" {option}>{flag}</option><worldbody>{world}'
        f'<body pos="0 0 1" {body}><joint name="hinge" axis="0 1 0" {damped} frictionloss="{friction}" {joint}/>'
        f'<geom size="{0.2 * length}" mass="{mass}" pos="0 0 {up * length}"/>{inner}</body></worldbody>{more}'
        f'<actuator>{others}<{kind} name="motor" joint="hinge" {motor}/></actuator></mujoco>',
        encoding="utf-8",
    )
    return path


def check_model(path: Path) -> EquationCheck:
    mapping = path.with_suffix(".yaml")
    mapping.write_text("format: pendulum_simulation/1\njoint: hinge\nactuator: motor\n", encoding="utf-8")
    made = open_simulation(str(path), str(mapping))
    assert made.check is not None
    return made.check()


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_that_the_equation_lacks_is_named_and_no_other(tmp_path: Path, feature: str) -> None:
    found = check_model(write_model(tmp_path / "model.xml", feature))
    assert found.causes == ((FEATURES[feature],) if FEATURES[feature] else ()), str(found)
    assert found.agrees == (not FEATURES[feature]), str(found)
    assert found.left is None or found.left <= TOLERANCE


def test_a_motor_behind_a_spring_is_named_and_not_taken_for_a_delay(tmp_path: Path) -> None:
    path = tmp_path / "x5_9.xml"
    path.write_text(mjcf(load_plant("x5_9")), encoding="utf-8")
    made = open_simulation(str(path))
    assert made.check is not None
    assert made.check().causes == ("a spring between motor and joint",)


@pytest.mark.parametrize(("inertia", "agrees"), [(1.03, True), (1.1, False), (0.9, False)])
def test_the_tolerance_is_five_per_cent_of_the_motion(inertia: float, agrees: bool) -> None:
    parameters = load_plant("dfki").with_values(coulomb_friction=0.0, load_friction=0.0)
    heavier = parameters.with_values(inertia=inertia * parameters.inertia)
    one, other = (make_plant(each, 0.005) for each in (heavier, parameters))
    assert check_equation(one, other).agrees == agrees


def test_two_features_are_both_named(tmp_path: Path) -> None:
    path = write_model(tmp_path / "model.xml", "spring")
    path.write_text(path.read_text(encoding="utf-8").replace("<option ", '<option density="1500" viscosity="1" '))
    assert set(check_model(path).causes) == {"a spring", "the fluid around it"}


def test_the_log_holds_the_equation_that_a_controller_is_designed_on(tmp_path: Path) -> None:
    made = open_simulation(str(write_model(tmp_path / "model.xml", "motor_delay")))
    found = made.plant.parameters
    (line,) = [remark for remark in made.remarks if remark.startswith("closest equation: ")]
    for name, unit in (("inertia", "kg m^2"), ("gravity", "N m"), ("transport_delay", "s"), ("effort_limit", "N m")):
        assert f"{name} {getattr(found, name):.6g} {unit}" in line


# --- Gymnasium -------------------------------------------------------------------------------------------------


class Odd(gymnasium.Env[Any, Any]):
    """A pendulum that hangs at 0, with one thing that is odd."""

    action_space = gymnasium.spaces.Box(-5.0, 5.0, (1,), np.float64)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, **odd: float) -> None:
        self.odd = odd
        self.dt = odd.get("dt", 0.01)
        self.x = np.zeros(2)
        self.waiting: list[float] = []
        self.torque = 0.0

    def _observe(self) -> Any:
        theta, speed = self.x + self.odd.get("noise", 0.0) * self.np_random.normal(size=2)
        theta = theta + self.odd.get("shown", 0.0)
        theta = 1.0 - theta if "mirrored" in self.odd else theta * self.odd.get("angle_unit", 1.0)
        if wrap := self.odd.get("wrap"):
            theta = (theta + 0.5 * wrap) % wrap - 0.5 * wrap
        return np.array([theta, speed * self.odd.get("speed_unit", 1.0)])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.x = np.array((options or {}).get("state", [0.0, 0.0]), dtype=float)
        self.x *= [1.0 - self.odd.get("no_angle", 0.0), 1.0 - self.odd.get("no_speed", 0.0)]
        self.waiting, self.torque = [0.0] * int(self.odd.get("delay", 0)), self.torque if "kept" in self.odd else 0.0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        odd, dt = self.odd, 0.001
        self.waiting.append(float(np.clip(action[0], -odd.get("clip", 5.0), odd.get("clip", 5.0))))
        wanted = self.waiting.pop(0)
        if abs(wanted) < odd.get("threshold", 0.0):
            wanted = 0.0
        wanted = math.copysign(max(abs(wanted) - odd.get("dead", 0.0), 0.0), wanted)
        theta, speed = self.x
        for _ in range(round(self.dt / dt) * int(odd.get("skip", 1))):
            lag = odd.get("lag", 0.0)
            self.torque += (wanted - self.torque) * (dt / lag if lag else 1.0)
            force = self.torque - 0.02 * speed - 1.5 * math.sin(theta - odd.get("zero", 0.0))
            force -= odd.get("drag", 0.0) * speed * abs(speed) + odd.get("dry", 0.0) * math.tanh(100.0 * speed)
            force -= odd.get("spring", 0.0) * theta + odd.get("constant", 0.0)
            force -= odd.get("second", 0.0) * math.sin(2.0 * theta)
            if abs(theta) > (stop := odd.get("stop", math.inf)):
                force -= 200.0 * math.copysign(abs(theta) - stop, theta) + 2.0 * speed
            speed += dt * force / 0.05
            theta += dt * speed
        self.x = np.array([theta, speed])
        return self._observe(), 0.0, abs(theta) > odd.get("ends", math.inf), False, {}


gymnasium.register("Odd-v0", entry_point=Odd)


@pytest.mark.parametrize(
    ("odd", "cause"),
    [
        ({}, ""),
        ({"noise": 1e-4}, ""),
        # Under its largest torque it turns by more than half a turn within a period.
        ({"dt": 0.1}, ""),
        ({"dead": 0.05}, "a dead zone of the action (below about 0.05"),
        ({"dead": 0.2, "dt": 0.05}, "a dead zone of the action (below about 0.2 N m"),
        ({"threshold": 0.3}, "a dead zone of the action (below about 0.3"),
        ({"wrap": 2.0 * math.pi}, ""),
        ({"noise": 0.1}, "noise (with another seed"),
        ({"wrap": math.pi}, "an angle that jumps by"),
        ({"no_angle": 1}, "a reset that is ignored"),
        ({"no_speed": 1}, "a reset that ignores the velocity"),
        (
            {"shown": 0.5},
            "another zero of the angle that is read than of the start (put at -3.14 rad, it is read as -2.64 rad)",
        ),
        ({"mirrored": 1}, "another sign, or swapped sine and cosine, of the angle that is read than of the start"),
        (
            {"angle_unit": 1.0 / math.pi},
            "another unit of the angle that is read than of the start (put at -3.14 rad, it is read as -1.00 rad)",
        ),
        ({"lag": 0.05, "kept": 1}, "a reset that leaves something behind (with the same seed a run differs by"),
        ({"delay": 3}, "a delay (an effort acts 30 ms later)"),
        ({"lag": 0.05}, "a lag of the effort"),
        ({"clip": 1.0}, "an action that is clipped (beyond about 1 N m more does nothing; the limit is 5 N m)"),
        ({"skip": 4}, "ms instead of 10 ms (frame skip)"),
        ({"speed_unit": 180.0 / math.pi}, "or a unit of velocity: its angle moves 0.0175 times as far"),
        ({"drag": 0.01}, "quadratic damping"),
        ({"dry": 0.3}, "dry friction"),
        ({"spring": 0.5}, "a spring"),
        ({"constant": 0.4}, "a constant torque"),
        ({"second": 0.4}, "a weight that is no sine of the angle"),
        ({"zero": 0.2}, "another zero of the angle"),
        ({"stop": 1.6}, "a stop or a contact (free swings are right from -1.57 to 1.57 rad only)"),
        ({"ends": 2.0}, "the environment ended its episode"),
    ],
)
def test_an_environment_that_is_odd_is_named_by_what_it_does(tmp_path: Path, odd: dict[str, float], cause: str) -> None:
    adapter = tmp_path / "adapter.yaml"
    adapter.write_text(
        "format: pendulum_simulation/1\nangle: {index: 0}\nvelocity: {index: 1}\ntorque: {index: 0}\n"
        f"start: {{options: state}}\nperiod: dt\nmake: {{{', '.join(f'{k}: {v}' for k, v in odd.items())}}}\n",
        encoding="utf-8",
    )
    made = open_simulation("gymnasium:Odd-v0", str(adapter))
    assert made.check is not None
    found = made.check()
    assert found.agrees == (not cause), str(found)
    assert cause in str(found)


@pytest.mark.parametrize(
    ("delay", "cause"), [(6, "a delay (an effort acts 60 ms later)"), (30, "an effort that does nothing within 200 ms")]
)
def test_a_delay_that_the_search_for_an_equation_cannot_see_is_reported_and_then_named(
    tmp_path: Path, delay: int, cause: str
) -> None:
    adapter = tmp_path / "adapter.yaml"
    text = "format: pendulum_simulation/1\nangle: {index: 0}\nvelocity: {index: 1}\ntorque: {index: 0}\n"
    text += f"start: {{options: state}}\nperiod: dt\nmake: {{delay: {delay}}}\n"
    adapter.write_text(text, encoding="utf-8")
    with pytest.raises(
        ParameterError, match=rf"moves it only in step {delay + 1} \(a delay\); expected equation: FILE"
    ):
        open_simulation("gymnasium:Odd-v0", str(adapter))
    plant = pendulum_plant(inertia=0.05, damping=0.02, gravity=1.5, effort_limit=5.0)
    adapter.write_text(f"{text}equation: {write_plant(tmp_path / 'plant.yaml', plant)}\n", encoding="utf-8")
    made = open_simulation("gymnasium:Odd-v0", str(adapter))
    assert made.check is not None
    assert cause in str(made.check())


@pytest.mark.parametrize("name", ["Pendulum-v1", "PendulumX59-v0"])
def test_environments_that_need_no_adapter_agree_at_their_coarse_period(name: str) -> None:
    made = open_simulation(f"gymnasium:{name}")
    assert made.check is not None
    assert made.check().agrees


# --- several joints --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cart_pole", "furuta"])
def test_several_joints_are_judged_one_by_one(name: str) -> None:
    parameters = load_mechanism(name)
    one, other = (MechanismPlant(parameters, 0.005) for _ in range(2))
    assert check_equation(one, other).agrees
    joints = list(parameters.joints)
    last = len(joints) - 1
    change = {f"{parameters.coordinates.names[last]}.damping": joints[last].damping + 0.05}
    softer = MechanismPlant(parameters.with_values(change), 0.005)
    found = check_equation(softer, other)
    assert not found.agrees
    assert found.errors[last] > TOLERANCE


# --- several joints --------------------------------------------------------------------------------------------


def _acrobot(**changes: float) -> PlantParameters:
    """Return an acrobot whose equation a model file of two plain links has."""
    return load_mechanism("acrobot_frictionless").with_values({"rotor_inertia": 0.0, "elbow.damping": 0.02, **changes})


def write_arm(folder: Path, plant: PlantParameters, elbow: str = "") -> tuple[str, str, str]:
    """Write an arm as others do: it stands at 0, clockwise, with names of its own; return model, mapping and plant."""
    (m_1, l_1, r_1, i_1), (m_2, _, r_2, i_2) = plant.values[:4], plant.values[4:8]
    own = [f'diaginertia="{i - m * r * r} {i - m * r * r} 1e-5"' for i, m, r in ((i_1, m_1, r_1), (i_2, m_2, r_2))]
    damping = [joint.damping for joint in plant.joints]
    model = folder / "arm.xml"
    model.write_text(
        '<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body pos="0 0 1">'
        f'<joint name="hip" axis="0 1 0" damping="{damping[0]}"/>'
        f'<inertial pos="0 0 {r_1}" mass="{m_1}" {own[0]}/><body pos="0 0 {l_1}">'
        f'<joint name="knee" axis="0 1 0" damping="{damping[1]}" {elbow}/>'
        f'<inertial pos="0 0 {r_2}" mass="{m_2}" {own[1]}/></body></body></worldbody>'
        '<actuator><motor joint="knee" gear="2" ctrlrange="-2 2"/></actuator></mujoco>',
        encoding="utf-8",
    )
    mapping = folder / "arm.yaml"
    mapping.write_text(
        "format: pendulum_simulation/1\n"
        "joints:\n  shoulder: {joint: hip, sign: -1}\n  elbow: {joint: knee, sign: -1}\n",
        encoding="utf-8",
    )
    return str(model), str(mapping), str(write_plant(folder / "plant.yaml", plant))


def test_an_arm_of_others_is_a_plant_of_two_joints_with_the_limit_of_its_own_motor(tmp_path: Path) -> None:
    made = open_simulation(*write_arm(tmp_path, _acrobot()))
    assert made.plant.parameters.effort_limits == (4.0,)
    assert "its 3.14159 rad are our 0, turned round" in made.remarks[0]
    assert "'knee' through actuator" in made.remarks[1]
    assert made.check is not None
    found = made.check()
    assert found.agrees, str(found)
    assert found.joints == ("shoulder", "elbow")


@pytest.mark.parametrize("name", ["cart_pole", "furuta", "reaction_wheel", "triple_pendulum"])
def test_exported_mechanisms_need_no_mapping_and_hang_at_zero(tmp_path: Path, name: str) -> None:
    path = tmp_path / "own.xml"
    path.write_text(mjcf(load_mechanism(name)), encoding="utf-8")
    made = open_simulation(str(path), plant=name)
    assert made.plant.parameters == load_mechanism(name)
    assert made.check is not None
    found = made.check()
    assert found.agrees, str(found)
    assert all("are our 0;" in remark for remark in made.remarks[: len(made.plant.parameters.joints)])


def test_joints_of_other_names_count_in_their_order_and_hang_at_zero(tmp_path: Path) -> None:
    text = mjcf(load_mechanism("cart_pole"))
    for joint in ("cart", "pole"):
        for key in ("name", "joint"):
            text = text.replace(f'{key}="{joint}"', f'{key}="their_{joint}"')
    (tmp_path / "theirs.xml").write_text(text, encoding="utf-8")
    made = open_simulation(str(tmp_path / "theirs.xml"), plant="cart_pole")
    assert made.check is not None
    assert made.check().agrees


def test_another_equation_of_two_joints_is_refused_with_its_joint_and_a_tested_cause(tmp_path: Path) -> None:
    model, mapping, _ = write_arm(tmp_path, _acrobot(), 'range="-40 40"')
    check = open_simulation(model, mapping, str(tmp_path / "plant.yaml")).check
    assert check is not None
    found = check()
    assert (found.agrees, found.causes) == (False, ("the range of a joint",)), str(found)
    heavier = write_plant(tmp_path / "heavier.yaml", _acrobot(mass_2=0.9))
    check = open_simulation(*write_arm(tmp_path, _acrobot())[:2], str(heavier)).check
    assert check is not None
    assert not check().agrees


def test_a_model_with_other_joints_than_the_plant_is_refused_in_one_sentence(tmp_path: Path) -> None:
    model, mapping, _ = write_arm(tmp_path, _acrobot())
    for plant, sentence in (
        (
            "cart_pole",
            r"has the joints hip \[rad\], knee \[rad\]; expected those of cart_pole, cart \[m\], pole \[rad\]",
        ),
        ("thesis", "plant is thesis, of one joint, whose equation is found; expected one of several, or none"),
    ):
        with pytest.raises(ParameterError, match=sentence):
            open_simulation(model, plant=plant)
    with pytest.raises(ParameterError, match=r"joints: unknown parameter 'shoulder'"):
        open_simulation(model, mapping, "cart_pole")
    with pytest.raises(ParameterError, match=r"has 2 hinges \(hip, knee\); expected one"):
        open_simulation(model)
