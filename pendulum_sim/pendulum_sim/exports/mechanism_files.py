"""URDF and MJCF of a plant of several joints, written from the same bodies as it is drawn with.

x points to the right, y away from the viewer, z up; hanging down is position 0 of every hinge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import Body
from pendulum_msgs_py.plants.joint_parameters import JointParameters
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters
from pendulum_sim.exports.xml_files import add, document_text, lateness, number, safe_name

__all__ = ["mechanism_mjcf", "mechanism_urdf"]

_ROD_RADIUS = 0.008
_ROD = "0.6 0.62 0.66 1"
_TIP = "0.85 0.3 0.2 1"
_CART = "0.25 0.25 0.28 1"
_FAST = 100.0
_TIMESTEP = 0.002


def mechanism_mjcf(parameters: MechanismParameters) -> str:
    """Return the MJCF of a plant for MuJoCo, with its rotors as armature of tendons.

    What MuJoCo lacks is left out: Stribeck's curve. Its dry friction is regularised: it creeps where this one
    sticks; its end stops are springs.

    Raises:
        ParameterError: A body has no positive inertia about its own centre of mass, which MuJoCo refuses.
    """
    mechanism = parameters.mechanism
    bodies = _checked_bodies(parameters)
    model = ElementTree.Element("mujoco", model=safe_name(parameters.name))
    add(model, "compiler", angle="radian", autolimits="true")
    add(
        model,
        "option",
        gravity=f"0 0 {number(-parameters.value('gravity'))}",
        timestep=number(_TIMESTEP),
        integrator="RK4",
    )
    world = add(model, "worldbody")
    add(world, "light", pos="0 -1 1.5", dir="0 0.5 -1")
    size = sum(math.dist(body.tip, (0.0, 0.0, 0.0)) for body in bodies)
    add(world, "camera", name="side", pos=f"0 {number(-4.0 * size)} 0", xyaxes="1 0 0 0 0 1")
    parent = world
    for body, joint, own in zip(bodies, mechanism.joints, parameters.joints, strict=True):
        parent = add(parent, "body", name=body.name, pos=_vector(body.origin))
        attributes = {"type": "hinge" if joint.unit == "rad" else "slide", "axis": _vector(body.axis)}
        if own.lower_stop is not None or own.upper_stop is not None:
            attributes["range"] = f"{number(_stop(own.lower_stop, -1e6))} {number(_stop(own.upper_stop, 1e6))}"
        add(
            parent,
            "joint",
            attributes,
            name=joint.name,
            damping=number(own.damping),
            frictionloss=number(own.coulomb_friction),
        )
        add(parent, "inertial", pos=_vector(body.centre), mass=number(body.mass), diaginertia=_vector(body.inertia))
        unseen = {"contype": "0", "conaffinity": "0"}
        if body.tip == (0.0, 0.0, 0.0):
            add(parent, "geom", unseen, type="box", size="0.08 0.05 0.03", rgba=_CART)
        else:
            ends = f"0 0 0 {_vector(body.tip)}"
            add(parent, "geom", unseen, type="capsule", fromto=ends, size=number(_ROD_RADIUS), rgba=_ROD)
            add(parent, "geom", unseen, type="sphere", pos=_vector(body.tip), size=number(2 * _ROD_RADIUS), rgba=_TIP)
    _add_rotors(model, parameters)
    actuators = add(model, "actuator")
    for index, actuator in zip(parameters.coordinates.driven, parameters.actuators, strict=True):
        late = lateness(actuator.time_constant, actuator.transport_delay, _TIMESTEP)
        limit = number(actuator.effort_limit)
        name = mechanism.joints[index].name
        add(actuators, "general", late, name=name, joint=name, ctrlrange=f"-{limit} {limit}", biastype="none")
    return document_text(model)


def mechanism_urdf(parameters: MechanismParameters) -> str:
    """Return the URDF of a plant, for RViz and Gazebo; it has no word for rotors, which are left out.

    Raises:
        ParameterError: A body has no positive inertia about its own centre of mass.
    """
    mechanism = parameters.mechanism
    robot = ElementTree.Element("robot", name=safe_name(parameters.name))
    parent = "base_link"
    add(robot, "link", name=parent)
    for body, joint, own in zip(_checked_bodies(parameters), mechanism.joints, parameters.joints, strict=True):
        link = add(robot, "link", name=body.name)
        inertial = add(link, "inertial")
        add(inertial, "origin", xyz=_vector(body.centre), rpy="0 0 0")
        add(inertial, "mass", value=number(body.mass))
        moments = {name: number(value) for name, value in zip(("ixx", "iyy", "izz"), body.inertia, strict=True)}
        add(inertial, "inertia", {**moments, "ixy": "0", "ixz": "0", "iyz": "0"})
        _urdf_visual(link, body)
        joint_of = add(robot, "joint", name=joint.name, type=_urdf_type(joint, own))
        add(joint_of, "parent", link=parent)
        add(joint_of, "child", link=body.name)
        add(joint_of, "origin", xyz=_vector(body.origin), rpy="0 0 0")
        add(joint_of, "axis", xyz=_vector(body.axis))
        effort = own.actuator.effort_limit if own.actuator is not None else 0.0
        limits = {"effort": number(effort), "velocity": number(_FAST)}
        if _urdf_type(joint, own) != "continuous":
            limits["lower"] = number(_stop(own.lower_stop, -1e6))
            limits["upper"] = number(_stop(own.upper_stop, 1e6))
        add(joint_of, "limit", limits)
        add(joint_of, "dynamics", damping=number(own.damping), friction=number(own.coulomb_friction))
        parent = body.name
    return document_text(robot)


def _add_rotors(model: ElementTree.Element, parameters: MechanismParameters) -> None:
    rotors = [rotor for rotor in parameters.mechanism.rotors(parameters.packed) if rotor.inertia > 0.0]
    if not rotors:
        return
    tendons = add(model, "tendon")
    for count, rotor in enumerate(rotors, 1):
        tendon = add(tendons, "fixed", name=f"rotor_{count}", armature=number(rotor.inertia))
        for joint, rate in zip(parameters.mechanism.joints, rotor.rates, strict=True):
            if rate != 0.0:
                add(tendon, "joint", joint=joint.name, coef=number(rate))


def _checked_bodies(parameters: MechanismParameters) -> tuple[Body, ...]:
    bodies = parameters.mechanism.bodies(parameters.packed)
    for body in bodies:
        if not min(body.inertia) > 0.0:
            raise ParameterError(
                f"{body.name} of plant {parameters.name!r} has {min(body.inertia):.3g} kg m^2 about its centre of mass;"
                " expected > 0: its inertia about the joint is less than mass * centre^2, and no file can say that"
            )
    return bodies


def _urdf_type(joint: Joint, own: JointParameters) -> str:
    if joint.unit == "m":
        return "prismatic"
    return "continuous" if own.lower_stop is None and own.upper_stop is None else "revolute"


def _urdf_visual(link: ElementTree.Element, body: Body) -> None:
    visual = add(link, "visual")
    length = math.dist(body.tip, (0.0, 0.0, 0.0))
    if length == 0.0:
        add(visual, "origin", xyz="0 0 0", rpy="0 0 0")
        add(add(visual, "geometry"), "box", size="0.16 0.1 0.06")
        add(add(visual, "material", name="cart_colour"), "color", rgba=_CART)
        return
    # A cylinder lies along z: along x it is turned about y.
    turned = "0 1.5707963267948966 0" if body.tip[0] else "0 0 0"
    add(visual, "origin", xyz=_vector([0.5 * value for value in body.tip]), rpy=turned)
    add(add(visual, "geometry"), "cylinder", radius=number(_ROD_RADIUS), length=number(length))
    add(add(visual, "material", name="rod_colour"), "color", rgba=_ROD)


def _stop(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _vector(values: Sequence[float]) -> str:
    return " ".join(number(value) for value in values)
