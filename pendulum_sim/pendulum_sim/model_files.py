"""URDF and MJCF of a plant, written from the same parameters as the simulation.

The parameters say M_c and G_c, not mass and length: any link with m l^2 <= M_c and m g l = G_c moves the same. The
one drawn has nine tenths of its inertia in the bob. Angle 0 hangs down along -z; positive turns the bob towards +x,
counter-clockwise for who looks along +y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import typer

from pendulum_msgs_py.contract.names import JOINT, LINK
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import torque_gain, total_damping
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_sim.ros2_control_tags import add_ros2_control

__all__ = ["LinkShape", "link_shape", "main", "mjcf", "urdf"]

STANDARD_GRAVITY = 9.80665
"""Acceleration of gravity in the files [m/s^2]."""
_BOB_SHARE = 0.9
_FLAT_LENGTH = 0.3
_ROD_RADIUS = 0.008
_STEEL = 7850.0


@dataclass(frozen=True)
class LinkShape:
    """A link that moves as the parameters say.

    Attributes:
        mass: m [kg].
        length: Distance of the centre of mass from the joint, l [m].
        inertia: Inertia about the centre of mass, parallel to the joint [kg m^2].
        bob_radius: Radius of a steel ball of that mass, for the eye [m].
    """

    mass: float
    length: float
    inertia: float
    bob_radius: float


def link_shape(parameters: PlantParameters) -> LinkShape:
    """Return mass, length and inertia of the link that is drawn.

    Args:
        parameters: The plant.
    """
    at_bob = _BOB_SHARE * parameters.inertia
    if parameters.gravity > 0.0:
        # m l^2 = at_bob and m g l = G
        length = at_bob * STANDARD_GRAVITY / parameters.gravity
        mass = at_bob / length**2
    else:
        length = _FLAT_LENGTH
        mass = at_bob / length**2
    radius = (3.0 * mass / (4.0 * math.pi * _STEEL)) ** (1.0 / 3.0)
    return LinkShape(mass, length, parameters.inertia - at_bob, min(radius, 0.4 * length))


def urdf(parameters: PlantParameters, *, ros2_control: str = "none", namespace: str = "/sim") -> str:
    """Return the URDF of the link, for RViz, robot_state_publisher and Gazebo; the joint bears the contract's name.

    URDF knows no motor behind a spring. Of a series-elastic plant the joint has the damping and dry friction of link
    and motor together, as in slow motion; the rotor's inertia joins that of the link.
    An effort is then that of the motor: ``torque_gain`` times what our plants are commanded.

    Args:
        parameters: The plant.
        ros2_control: Hardware for ros2_control: ``none``, ``gz`` or ``topic_based``.
        namespace: Namespace of the plant behind ``topic_based``.
    """
    shape = link_shape(parameters)
    drive = parameters.drivetrain
    speed = 100.0 if drive is None else drive.supply_voltage / (drive.back_emf_constant * drive.gear_ratio)
    robot = ElementTree.Element("robot", name=_safe_name(parameters.name))
    base = _add(robot, "link", name="base_link")
    _urdf_visual(base, ("box", {"size": "0.06 0.1 0.06"}), f"0 {_n(0.06)} 0", "0 0 0", "0.25 0.25 0.28 1")
    link = _add(robot, "link", name=LINK)
    inertial = _add(link, "inertial")
    _add(inertial, "origin", xyz=f"0 0 {_n(-shape.length)}", rpy="0 0 0")
    _add(inertial, "mass", value=_n(shape.mass))
    rotor = drive.reflected_inertia if drive is not None else 0.0
    i = _n(shape.inertia + rotor)
    _add(inertial, "inertia", ixx=i, iyy=i, izz=_n(0.02 * shape.inertia), ixy="0", ixz="0", iyz="0")
    rod = {"radius": _n(_ROD_RADIUS), "length": _n(shape.length)}
    _urdf_visual(link, ("cylinder", rod), f"0 0 {_n(-0.5 * shape.length)}", "0 0 0", "0.6 0.62 0.66 1")
    _urdf_visual(
        link,
        ("sphere", {"radius": _n(shape.bob_radius)}),
        f"0 0 {_n(-shape.length)}",
        "0 0 0",
        "0.85 0.3 0.2 1",
    )
    joint = _add(robot, "joint", name=JOINT, type="continuous")
    _add(joint, "parent", link="base_link")
    _add(joint, "child", link=LINK)
    # The measured angle is angle_offset when the link hangs: the frame is turned back by as much.
    _add(joint, "origin", xyz="0 0 0", rpy=f"0 {_n(parameters.angle_offset)} 0")
    _add(joint, "axis", xyz="0 -1 0")
    # topic_based drives our plants, which take commands; anything else moves the joint itself.
    gain = 1.0 if ros2_control == "topic_based" else torque_gain(parameters)
    limit = gain * parameters.effort_limit
    friction = parameters.coulomb_friction + (drive.motor_coulomb_friction if drive is not None else 0.0)
    _add(joint, "limit", effort=_n(limit), velocity=_n(speed))
    _add(joint, "dynamics", damping=_n(total_damping(parameters)), friction=_n(friction))
    add_ros2_control(robot, ros2_control, namespace, limit)
    return _text(robot)


def mjcf(parameters: PlantParameters) -> str:
    """Return the MJCF of the plant for MuJoCo.

    What MuJoCo has no word for is left out: Stribeck's curve, friction that grows with the load, transport delay,
    and the spring's hysteresis and hardening. Its dry friction is regularised: it creeps where ours sticks.

    Args:
        parameters: The plant; with a drivetrain there is a second joint, the motor's, coupled by a spring.
    """
    shape = link_shape(parameters)
    drive = parameters.drivetrain
    model = ElementTree.Element("mujoco", model=_safe_name(parameters.name))
    _add(model, "compiler", angle="radian", autolimits="true")
    flat = parameters.gravity == 0.0
    _add(
        model,
        "option",
        gravity="0 0 0" if flat else f"0 0 {_n(-STANDARD_GRAVITY)}",
        timestep="0.002" if drive is None else "0.00025",
        integrator="implicitfast",
    )
    world = _add(model, "worldbody")
    _add(world, "light", pos="0 -1 1.5", dir="0 0.5 -1")
    _add(world, "camera", name="side", pos=f"0 {_n(-4.0 * shape.length)} 0", xyaxes="1 0 0 0 0 1")
    link = _add(world, "body", name=LINK)
    _add(
        link,
        "joint",
        name=JOINT,
        type="hinge",
        axis="0 -1 0",
        ref=_n(parameters.angle_offset),
        damping=_n(parameters.damping),
        frictionloss=_n(parameters.coulomb_friction),
    )
    _add(
        link,
        "inertial",
        pos=f"0 0 {_n(-shape.length)}",
        mass=_n(shape.mass),
        diaginertia=f"{_n(shape.inertia)} {_n(shape.inertia)} {_n(0.02 * shape.inertia)}",
    )
    appearance = {"contype": "0", "conaffinity": "0"}
    _add(
        link, "geom", type="capsule", fromto=f"0 0 0 0 0 {_n(-shape.length)}", size=_n(_ROD_RADIUS),
        rgba="0.6 0.62 0.66 1", attributes=appearance,
    )  # fmt: skip
    _add(
        link, "geom", type="sphere", pos=f"0 0 {_n(-shape.length)}", size=_n(shape.bob_radius),
        rgba="0.85 0.3 0.2 1", attributes=appearance,
    )  # fmt: skip
    driven, gain = JOINT, 1.0
    if drive is not None:
        driven, gain = "motor_joint", torque_gain(parameters)
        motor = _add(world, "body", name="motor")
        _add(
            motor, "joint", name=driven, type="hinge", axis="0 -1 0", armature=_n(drive.reflected_inertia),
            damping=_n(total_damping(parameters) - parameters.damping), frictionloss=_n(drive.motor_coulomb_friction),
        )  # fmt: skip
        _add(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
        tendons = _add(model, "tendon")
        spring = _add(
            tendons,
            "fixed",
            name="spring",
            stiffness=_n(drive.stiffness),
            springlength=_n(-parameters.angle_offset),
        )
        _add(spring, "joint", joint=driven, coef="1")
        _add(spring, "joint", joint=JOINT, coef="-1")
    actuators = _add(model, "actuator")
    limit = f"{_n(-parameters.effort_limit)} {_n(parameters.effort_limit)}"
    lag = (
        {"dyntype": "filterexact", "dynprm": _n(parameters.actuator_time_constant)}
        if parameters.actuator_time_constant > 0.0
        else {}
    )
    _add(
        actuators,
        "general",
        name="effort",
        joint=driven,
        ctrlrange=limit,
        gainprm=_n(gain),
        biastype="none",
        attributes=lag,
    )
    return _text(model)


def _urdf_visual(
    link: ElementTree.Element, geometry: tuple[str, dict[str, str]], xyz: str, rpy: str, rgba: str
) -> None:
    shape, sizes = geometry
    visual = _add(link, "visual")
    _add(visual, "origin", xyz=xyz, rpy=rpy)
    _add(_add(visual, "geometry"), shape, sizes)
    material = _add(visual, "material", name=f"{shape}_colour")
    _add(material, "color", rgba=rgba)


def _add(
    parent: ElementTree.Element, tag: str, attributes: Mapping[str, str] | None = None, **more: str
) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, {**(attributes or {}), **more})


def _n(value: float) -> str:
    return repr(float(value))


def _safe_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "pendulum"


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def export(
    plant: Annotated[str, typer.Option(help="Preset or path of a plant file.")] = "thesis",
    kind: Annotated[str, typer.Option("--format", help="urdf or mjcf.")] = "urdf",
    output: Annotated[Path | None, typer.Option(help="File to write; standard output by default.")] = None,
    ros2_control: Annotated[
        str, typer.Option(help="In a URDF, hardware for ros2_control: none, gz (Gazebo) or topic_based (our plants).")
    ] = "none",
    namespace: Annotated[str, typer.Option(help="Namespace of the plant behind topic_based.")] = "/sim",
) -> None:
    """Write the URDF or MJCF of a plant.

    Example: python -m pendulum_sim export_model --plant x5_9 --format mjcf --output x5_9.xml
    """
    if kind not in {"urdf", "mjcf"}:
        raise ParameterError(f"format is {kind!r}; expected urdf or mjcf")
    if kind == "mjcf" and ros2_control != "none":
        raise ParameterError(f"ros2_control is {ros2_control!r} for mjcf; expected --format urdf, MuJoCo knows none")
    parameters = load_plant(plant)
    text = mjcf(parameters) if kind == "mjcf" else urdf(parameters, ros2_control=ros2_control, namespace=namespace)
    if output is None:
        typer.echo(text, nl=False)
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError(f"{output} cannot be written: {error.strerror}") from error


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m pendulum_sim export_model")
