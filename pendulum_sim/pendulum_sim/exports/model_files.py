"""``export_model``: write a plant as URDF or MJCF, from the same bodies as it is drawn with.

x points right, y away from the viewer, z up; position 0 of a hinge hangs down. A pendulum has M_c and G_c, not mass and
length: any link with m l^2 <= M_c and m g l = G_c moves the same. The exported one has nine tenths of its inertia in
the bob, which positive angles turn towards +x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import SubElement

import typer

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import Body
from pendulum_msgs_py.mechanisms.mechanism import STANDARD_GRAVITY
from pendulum_msgs_py.plants.equilibrium import torque_gain, total_damping
from pendulum_msgs_py.plants.joint_parameters import JointParameters, SeriesElasticParameters
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option
from pendulum_sim.exports.ros2_control_tags import add_ros2_control

__all__ = ["main", "mjcf", "urdf"]

_TIMESTEP, _STIFF_TIMESTEP = 0.002, 0.00025
"""Timestep of rigid links, and behind a spring [s]."""
_ROD_RADIUS = 0.008
_STEEL = 7850.0
_CASING, _ROD, _BOB = "0.25 0.25 0.28 1", "0.6 0.62 0.66 1", "0.85 0.3 0.2 1"
_FAST = 100.0
"""Velocity limit without a drivetrain [rad/s or m/s]."""
_ORIGIN = (0.0, 0.0, 0.0)


class _AtJoint(NamedTuple):
    """Limits, friction and rotor inertia at a joint, motor and gears in slow motion included."""

    effort: float
    velocity: float
    damping: float
    friction: float
    rotor: float


def urdf(parameters: PlantParameters, *, ros2_control: str = "none", namespace: str = "/sim") -> str:
    """Return the URDF of a plant, for RViz, robot_state_publisher and Gazebo; joints have the contract's names.

    URDF has no rotors and no motor behind a spring: a series-elastic joint gets the damping and dry friction of link
    and motor together, as in slow motion, and the rotor's inertia joins the link's. Its effort is the motor's:
    ``torque_gain`` times the command of this project's plants. ``ros2_control`` is ``none``, or of a pendulum ``gz`` or
    ``topic_based``, whose plant is in ``namespace``.

    Raises:
        ParameterError: A body has no positive inertia about its centre of mass; or ros2_control with several joints.
    """
    if ros2_control != "none" and not parameters.is_pendulum:
        raise ParameterError(
            f"ros2_control is {ros2_control!r} for {parameters.name!r}; expected a plant of one joint with it"
        )
    robot = ElementTree.Element("robot", name=_safe_name(parameters.name))
    parent = "base_link"
    base = SubElement(robot, "link", name=parent)
    if len(parameters.joints) == 1:
        _urdf_visual(base, "box", (0.0, 0.06, 0.0), _CASING, size="0.06 0.1 0.06")
    limit = 0.0
    for body, joint, own in _parts(parameters):
        at = _at_joint(own, parameters)
        link = SubElement(robot, "link", name=body.name)
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=_vector(body.centre), rpy="0 0 0")
        SubElement(inertial, "mass", value=_number(body.mass))
        ixx, iyy, izz = body.inertia
        moments = {"ixx": _number(ixx + at.rotor), "iyy": _number(iyy + at.rotor), "izz": _number(izz)}
        SubElement(inertial, "inertia", {**moments, "ixy": "0", "ixz": "0", "iyz": "0"})
        _urdf_link(link, body, _tip_radius(parameters, body))
        kind = _urdf_type(joint, own)
        joint_of = SubElement(robot, "joint", name=joint.name, type=kind)
        SubElement(joint_of, "parent", link=parent)
        SubElement(joint_of, "child", link=body.name)
        # The measured angle of a hanging link is angle_offset: the frame is turned back by it.
        SubElement(joint_of, "origin", xyz=_vector(body.origin), rpy=f"0 {_number(own.angle_offset)} 0")
        SubElement(joint_of, "axis", xyz=_vector(body.axis))
        # topic_based sends commands to this project's plants; other hardware moves the joint itself.
        limit = at.effort
        if ros2_control == "topic_based":
            limit = parameters.effort_limit
        limits = {"effort": _number(limit), "velocity": _number(at.velocity)}
        if kind != "continuous":
            limits["lower"], limits["upper"] = _number(_stop(own.lower_stop, -1e6)), _number(_stop(own.upper_stop, 1e6))
        SubElement(joint_of, "limit", limits)
        SubElement(joint_of, "dynamics", damping=_number(at.damping), friction=_number(at.friction))
        parent = body.name
    add_ros2_control(robot, ros2_control, namespace, limit)
    return _document_text(robot)


def _refuse_torques(parameters: PlantParameters, kind: str) -> None:
    for joint, own in zip(parameters.mechanism.joints, parameters.joints, strict=True):
        for name, value in zip(JOINT_TORQUES, own.torques, strict=True):
            if value != 0.0:
                unit = joint.drag_unit if name == "quadratic_drag" else joint.effort_unit
                raise ParameterError(
                    f"{name} of {joint.name} is {value:g} {unit}, which {kind.upper()} cannot express; expected a "
                    "plant without quadratic drag and periodic torques: set them to 0 for an export without them"
                )


def mjcf(parameters: PlantParameters) -> str:
    """Return the MJCF of a plant for MuJoCo, with its rotors as armature of tendons.

    MuJoCo has no Stribeck curve, further friction terms, or hysteresis and hardening of a spring. Its dry friction
    creeps where this one sticks; its end stops are springs. A drivetrain is a second joint, the motor's, coupled by a
    spring. A motor's control is its voltage, without dead band; its back EMF is the actuator's bias.

    Raises:
        ParameterError: A body has no positive inertia about its centre of mass.
    """
    drive, parts = parameters.drivetrain, _parts(parameters)
    one = len(parts) == 1
    gravity = parameters.value("gravity")
    if one:
        gravity = STANDARD_GRAVITY if gravity > 0.0 else 0.0
    timestep = _TIMESTEP if drive is None else _STIFF_TIMESTEP
    if not one and (lags := [actuator.time_constant for actuator in parameters.actuators if actuator.time_constant]):
        # MuJoCo's Runge-Kutta integrates a lag too, and is unstable with longer steps.
        timestep /= math.ceil(timestep / (2.0 * min(lags)))
    model = ElementTree.Element("mujoco", model=_safe_name(parameters.name))
    SubElement(model, "compiler", angle="radian", autolimits="true")
    integrator = "implicitfast" if one else "RK4"
    SubElement(model, "option", gravity=f"0 0 {_number(-gravity)}", timestep=_number(timestep), integrator=integrator)
    world = SubElement(model, "worldbody")
    SubElement(world, "light", pos="0 -1 1.5", dir="0 0.5 -1")
    size = sum(math.dist(body.tip, _ORIGIN) for body, _, _ in parts)
    SubElement(world, "camera", name="side", pos=f"0 {_number(-4.0 * size)} 0", xyaxes="1 0 0 0 0 1")
    parent = world
    for body, joint, own in parts:
        parent = SubElement(parent, "body", name=body.name, pos=_vector(body.origin))
        attributes = {"type": "hinge" if joint.unit == "rad" else "slide", "axis": _vector(body.axis)}
        if own.lower_stop is not None or own.upper_stop is not None:
            attributes["range"] = f"{_number(_stop(own.lower_stop, -1e6))} {_number(_stop(own.upper_stop, 1e6))}"
        friction = {"damping": _number(own.damping), "frictionloss": _number(own.coulomb_friction)}
        SubElement(parent, "joint", attributes, name=joint.name, ref=_number(own.angle_offset), **friction)
        SubElement(
            parent, "inertial", pos=_vector(body.centre), mass=_number(body.mass), diaginertia=_vector(body.inertia)
        )
        unseen = {"contype": "0", "conaffinity": "0"}
        if body.tip == _ORIGIN:
            SubElement(parent, "geom", unseen, type="box", size="0.08 0.05 0.03", rgba=_CASING)
        else:
            ends, radius = f"0 0 0 {_vector(body.tip)}", _number(_tip_radius(parameters, body))
            SubElement(parent, "geom", unseen, type="capsule", fromto=ends, size=_number(_ROD_RADIUS), rgba=_ROD)
            SubElement(parent, "geom", unseen, type="sphere", pos=_vector(body.tip), size=radius, rgba=_BOB)
    gain = {}
    if drive is not None:
        _add_motor(model, world, drive, parameters)
        gain = {"gainprm": _number(torque_gain(parameters))}
    _add_rotors(model, parameters)
    actuators = SubElement(model, "actuator")
    for index, actuator in zip(parameters.coordinates.driven, parameters.actuators, strict=True):
        late = _lateness(actuator.time_constant, actuator.transport_delay, timestep)
        limit, joint_name = _number(actuator.command_limit), parameters.coordinates.names[index]
        names = {"name": "effort" if one else joint_name, "joint": "motor_joint" if drive is not None else joint_name}
        bias = {"biastype": "none"}
        if (motor := actuator.motor) is not None:
            names["name"] = f"{joint_name}_voltage"
            gain = {"gainprm": _number(motor.gain)}
            bias = {"biastype": "affine", "biasprm": f"0 0 {_number(-motor.damping)}"}
        SubElement(actuators, "general", {**late, **names, **gain}, ctrlrange=f"-{limit} {limit}", **bias)
    return _document_text(model)


def _parts(parameters: PlantParameters) -> list[tuple[Body, Joint, JointParameters]]:
    bodies = parameters.mechanism.bodies(parameters.packed)
    for body in bodies:
        if not min(body.inertia) > 0.0:
            raise ParameterError(
                f"{body.name} of plant {parameters.name!r} has {min(body.inertia):.3g} kg m^2 about its centre of mass;"
                " expected > 0: its inertia about the joint is less than mass * centre^2, and no file can say that"
            )
    return list(zip(bodies, parameters.mechanism.joints, parameters.joints, strict=True))


def _at_joint(own: JointParameters, parameters: PlantParameters) -> _AtJoint:
    effort, drive = 0.0 if own.actuator is None else own.actuator.effort_limit, own.drivetrain
    if drive is None:
        return _AtJoint(effort, _FAST, own.damping, own.coulomb_friction, 0.0)
    return _AtJoint(
        torque_gain(parameters) * effort,
        drive.supply_voltage / (drive.back_emf_constant * drive.gear_ratio),
        total_damping(parameters),
        own.coulomb_friction + drive.motor_coulomb_friction,
        drive.reflected_inertia,
    )


def _tip_radius(parameters: PlantParameters, body: Body) -> float:
    """Return the radius of the ball at the end of a link, of a pendulum's a steel bob's [m]."""
    if len(parameters.joints) > 1:
        return 2.0 * _ROD_RADIUS
    return min((3.0 * body.mass / (4.0 * math.pi * _STEEL)) ** (1.0 / 3.0), 0.4 * math.dist(body.tip, _ORIGIN))


def _add_motor(
    model: ElementTree.Element, world: ElementTree.Element, drive: SeriesElasticParameters, parameters: PlantParameters
) -> None:
    motor = SubElement(world, "body", name="motor")
    damping, friction = _number(total_damping(parameters) - parameters.damping), _number(drive.motor_coulomb_friction)
    hinge = {"type": "hinge", "axis": "0 -1 0", "armature": _number(drive.reflected_inertia)}
    SubElement(motor, "joint", hinge, name="motor_joint", damping=damping, frictionloss=friction)
    SubElement(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
    rest = _number(-parameters.angle_offset)
    spring = SubElement(
        SubElement(model, "tendon"), "fixed", name="spring", stiffness=_number(drive.stiffness), springlength=rest
    )
    SubElement(spring, "joint", joint="motor_joint", coef="1")
    SubElement(spring, "joint", joint=JOINT, coef="-1")


def _add_rotors(model: ElementTree.Element, parameters: PlantParameters) -> None:
    rotors = [rotor for rotor in parameters.mechanism.rotors(parameters.packed) if rotor.inertia > 0.0]
    if not rotors:
        return
    tendons = SubElement(model, "tendon")
    for count, rotor in enumerate(rotors, 1):
        tendon = SubElement(tendons, "fixed", name=f"rotor_{count}", armature=_number(rotor.inertia))
        for joint, rate in zip(parameters.mechanism.joints, rotor.rates, strict=True):
            if rate != 0.0:
                SubElement(tendon, "joint", joint=joint.name, coef=_number(rate))


def _urdf_type(joint: Joint, own: JointParameters) -> str:
    if joint.unit == "m":
        return "prismatic"
    return "continuous" if own.lower_stop is None and own.upper_stop is None else "revolute"


def _urdf_link(link: ElementTree.Element, body: Body, radius: float) -> None:
    length = math.dist(body.tip, _ORIGIN)
    if length == 0.0:
        _urdf_visual(link, "box", _ORIGIN, _CASING, size="0.16 0.1 0.06")
        return
    # A cylinder lies along z.
    turned = "0 1.5707963267948966 0" if body.tip[0] else "0 0 0"
    middle = [0.5 * value for value in body.tip]
    _urdf_visual(link, "cylinder", middle, _ROD, turned, radius=_number(_ROD_RADIUS), length=_number(length))
    _urdf_visual(link, "sphere", body.tip, _BOB, radius=_number(radius))


def _urdf_visual(
    link: ElementTree.Element, shape: str, xyz: Sequence[float], rgba: str, rpy: str = "0 0 0", **sizes: str
) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=_vector(xyz), rpy=rpy)
    SubElement(SubElement(visual, "geometry"), shape, sizes)
    SubElement(SubElement(visual, "material", name=f"{shape}_colour"), "color", rgba=rgba)


def _stop(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _vector(values: Sequence[float]) -> str:
    return " ".join(_number(value) for value in values)


def export(
    plant: Annotated[str, typer.Option(help="Preset or path of a plant file.")] = "thesis",
    kind: Annotated[str, typer.Option("--format", help="urdf or mjcf.")] = "urdf",
    output: Annotated[Path | None, out_option("File to write; standard output by default.")] = None,
    ros2_control: Annotated[
        str, typer.Option(help="In a URDF, hardware for ros2_control: none, gz (Gazebo) or topic_based (our plants).")
    ] = "none",
    namespace: Annotated[str, typer.Option(help="Namespace of the plant behind topic_based.")] = "/sim",
) -> None:
    """Write the URDF or MJCF of a plant.

    Example: python -m pendulum_sim export_model --plant x5_9 --format mjcf --out x5_9.xml
    """
    if kind not in {"urdf", "mjcf"}:
        raise ParameterError(f"format is {kind!r}; expected urdf or mjcf")
    if kind == "mjcf" and ros2_control != "none":
        raise ParameterError(f"ros2_control is {ros2_control!r} for mjcf; expected --format urdf, MuJoCo knows none")
    parameters = load_mechanism(plant)
    _refuse_torques(parameters, kind)
    text = mjcf(parameters) if kind == "mjcf" else urdf(parameters, ros2_control=ros2_control, namespace=namespace)
    if output is None:
        typer.echo(text, nl=False)
        return
    with writing(f"model file {output}", ParameterError):
        write_atomically(output, text)


def _number(value: float) -> str:
    """Return a number as text with all digits."""
    return repr(float(value))


def _lateness(lag: float, delay: float, timestep: float) -> dict[str, str]:
    """Return a MuJoCo actuator's attributes for lag and transport delay [s]; a delay needs MuJoCo 4 or later."""
    attributes = {"dyntype": "filterexact", "dynprm": _number(lag)} if lag > 0.0 else {}
    if delay > 0.0:
        attributes |= {"delay": _number(delay), "nsample": str(math.ceil(delay / timestep - 1e-9) + 1)}
    return attributes


def _safe_name(name: str) -> str:
    """Return a name of letters, digits, ``_`` and ``-``."""
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "pendulum"


def _document_text(root: ElementTree.Element) -> str:
    """Return the document, indented."""
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


main = command_line(export, "python -m pendulum_sim export_model")
