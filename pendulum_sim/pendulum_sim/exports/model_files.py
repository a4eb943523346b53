"""``export_model``: write a plant as URDF or MJCF.

The parameters are M_c and G_c, not mass and length: any link with m l^2 <= M_c and m g l = G_c moves the same. The
one drawn has nine tenths of its inertia in the bob. Angle 0 hangs down along -z; positive turns the bob towards +x,
counter-clockwise seen along +y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import typer

from pendulum_msgs_py.contract.names import JOINT, LINK
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import torque_gain, total_damping
from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, is_mechanism, load_plant
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.options import out_option
from pendulum_msgs_py.whole_file import write_whole, writing
from pendulum_sim.exports.mechanism_files import mechanism_mjcf, mechanism_urdf
from pendulum_sim.exports.ros2_control_tags import add_ros2_control
from pendulum_sim.exports.xml_files import add, document_text, lateness, number, safe_name

__all__ = ["LinkShape", "any_urdf", "link_shape", "main", "mjcf", "urdf"]

STANDARD_GRAVITY = 9.80665
"""Acceleration of gravity in the files [m/s^2]."""
_TIMESTEP, _STIFF_TIMESTEP = 0.002, 0.00025
"""Timestep of a rigid link, and of one behind a spring [s]."""
_BOB_SHARE = 0.9
_FLAT_LENGTH = 0.3
_ROD_RADIUS = 0.008
_STEEL = 7850.0
_CASING, _ROD, _BOB = "0.25 0.25 0.28 1", "0.6 0.62 0.66 1", "0.85 0.3 0.2 1"


@dataclass(frozen=True)
class LinkShape:
    """A link with the dynamics of the parameters.

    Attributes:
        mass: m [kg].
        length: Distance of the centre of mass from the joint, l [m].
        inertia: Inertia about the centre of mass, parallel to the joint [kg m^2].
        bob_radius: Radius of a steel ball of that mass, for drawing [m].
    """

    mass: float
    length: float
    inertia: float
    bob_radius: float


def link_shape(parameters: PlantParameters) -> LinkShape:
    """Return mass, length and inertia of the link that is drawn."""
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

    URDF has no motor behind a spring. Of a series-elastic plant the joint has the damping and dry friction of link
    and motor together, as in slow motion; the rotor's inertia joins that of the link.
    An effort is then that of the motor: ``torque_gain`` times the command of this project's plants.

    Args:
        parameters: The plant.
        ros2_control: Hardware for ros2_control: ``none``, ``gz`` or ``topic_based``.
        namespace: Namespace of the plant behind ``topic_based``.
    """
    shape = link_shape(parameters)
    drive = parameters.drivetrain
    speed = 100.0 if drive is None else drive.supply_voltage / (drive.back_emf_constant * drive.gear_ratio)
    robot = ElementTree.Element("robot", name=safe_name(parameters.name))
    base = add(robot, "link", name="base_link")
    _urdf_visual(base, ("box", {"size": "0.06 0.1 0.06"}), f"0 {number(0.06)} 0", _CASING)
    link = add(robot, "link", name=LINK)
    inertial = add(link, "inertial")
    add(inertial, "origin", xyz=f"0 0 {number(-shape.length)}", rpy="0 0 0")
    add(inertial, "mass", value=number(shape.mass))
    rotor = drive.reflected_inertia if drive is not None else 0.0
    i = number(shape.inertia + rotor)
    add(inertial, "inertia", ixx=i, iyy=i, izz=number(0.02 * shape.inertia), ixy="0", ixz="0", iyz="0")
    rod = {"radius": number(_ROD_RADIUS), "length": number(shape.length)}
    _urdf_visual(link, ("cylinder", rod), f"0 0 {number(-0.5 * shape.length)}", _ROD)
    _urdf_visual(link, ("sphere", {"radius": number(shape.bob_radius)}), f"0 0 {number(-shape.length)}", _BOB)
    joint = add(robot, "joint", name=JOINT, type="continuous")
    add(joint, "parent", link="base_link")
    add(joint, "child", link=LINK)
    # The measured angle is angle_offset when the link hangs: the frame is turned back by as much.
    add(joint, "origin", xyz="0 0 0", rpy=f"0 {number(parameters.angle_offset)} 0")
    add(joint, "axis", xyz="0 -1 0")
    # topic_based drives this project's plants, which take commands; anything else moves the joint itself.
    gain = 1.0 if ros2_control == "topic_based" else torque_gain(parameters)
    limit = gain * parameters.effort_limit
    friction = parameters.coulomb_friction + (drive.motor_coulomb_friction if drive is not None else 0.0)
    add(joint, "limit", effort=number(limit), velocity=number(speed))
    add(joint, "dynamics", damping=number(total_damping(parameters)), friction=number(friction))
    add_ros2_control(robot, ros2_control, namespace, limit)
    return document_text(robot)


def mjcf(parameters: PlantParameters) -> str:
    """Return the MJCF of the plant for MuJoCo.

    What MuJoCo has no word for is left out: Stribeck's curve, further friction terms, and the spring's hysteresis and
    hardening. Its dry friction is regularised: it creeps where this one sticks.

    Args:
        parameters: The plant; with a drivetrain there is a second joint, the motor's, coupled by a spring.
    """
    shape = link_shape(parameters)
    drive = parameters.drivetrain
    model = ElementTree.Element("mujoco", model=safe_name(parameters.name))
    add(model, "compiler", angle="radian", autolimits="true")
    flat = parameters.gravity == 0.0
    add(
        model,
        "option",
        gravity="0 0 0" if flat else f"0 0 {number(-STANDARD_GRAVITY)}",
        timestep=number(_TIMESTEP if drive is None else _STIFF_TIMESTEP),
        integrator="implicitfast",
    )
    world = add(model, "worldbody")
    add(world, "light", pos="0 -1 1.5", dir="0 0.5 -1")
    add(world, "camera", name="side", pos=f"0 {number(-4.0 * shape.length)} 0", xyaxes="1 0 0 0 0 1")
    link = add(world, "body", name=LINK)
    add(
        link,
        "joint",
        name=JOINT,
        type="hinge",
        axis="0 -1 0",
        ref=number(parameters.angle_offset),
        damping=number(parameters.damping),
        frictionloss=number(parameters.coulomb_friction),
    )
    add(
        link,
        "inertial",
        pos=f"0 0 {number(-shape.length)}",
        mass=number(shape.mass),
        diaginertia=f"{number(shape.inertia)} {number(shape.inertia)} {number(0.02 * shape.inertia)}",
    )
    appearance = {"contype": "0", "conaffinity": "0"}
    add(
        link,
        "geom",
        type="capsule",
        fromto=f"0 0 0 0 0 {number(-shape.length)}",
        size=number(_ROD_RADIUS),
        rgba=_ROD,
        attributes=appearance,
    )
    add(
        link,
        "geom",
        type="sphere",
        pos=f"0 0 {number(-shape.length)}",
        size=number(shape.bob_radius),
        rgba=_BOB,
        attributes=appearance,
    )
    driven, gain = JOINT, 1.0
    if drive is not None:
        driven, gain = "motor_joint", torque_gain(parameters)
        motor = add(world, "body", name="motor")
        add(
            motor,
            "joint",
            name=driven,
            type="hinge",
            axis="0 -1 0",
            armature=number(drive.reflected_inertia),
            damping=number(total_damping(parameters) - parameters.damping),
            frictionloss=number(drive.motor_coulomb_friction),
        )
        add(motor, "inertial", pos="0 0 0", mass="1e-6", diaginertia="1e-9 1e-9 1e-9")
        tendons = add(model, "tendon")
        spring = add(
            tendons,
            "fixed",
            name="spring",
            stiffness=number(drive.stiffness),
            springlength=number(-parameters.angle_offset),
        )
        add(spring, "joint", joint=driven, coef="1")
        add(spring, "joint", joint=JOINT, coef="-1")
    actuators = add(model, "actuator")
    limit = f"{number(-parameters.effort_limit)} {number(parameters.effort_limit)}"
    timestep = _TIMESTEP if drive is None else _STIFF_TIMESTEP
    late = lateness(parameters.actuator_time_constant, parameters.transport_delay, timestep)
    add(
        actuators,
        "general",
        name="effort",
        joint=driven,
        ctrlrange=limit,
        gainprm=number(gain),
        biastype="none",
        attributes=late,
    )
    return document_text(model)


def _urdf_visual(link: ElementTree.Element, geometry: tuple[str, dict[str, str]], xyz: str, rgba: str) -> None:
    shape, sizes = geometry
    visual = add(link, "visual")
    add(visual, "origin", xyz=xyz, rpy="0 0 0")
    add(add(visual, "geometry"), shape, sizes)
    material = add(visual, "material", name=f"{shape}_colour")
    add(material, "color", rgba=rgba)


def any_urdf(plant: str) -> str:
    """Return the URDF of a preset or plant file, of one joint or more.

    Raises:
        ParameterError: No such preset or file, or the file is refused.
    """
    return mechanism_urdf(load_mechanism(plant)) if is_mechanism(plant) else urdf(load_plant(plant))


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
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
    if is_mechanism(plant):
        if ros2_control != "none":
            raise ParameterError(
                f"ros2_control is {ros2_control!r} for {plant!r}; expected a plant of one joint with it"
            )
        mechanism = load_mechanism(plant)
        text = mechanism_mjcf(mechanism) if kind == "mjcf" else mechanism_urdf(mechanism)
    else:
        parameters = load_plant(plant)
        text = mjcf(parameters) if kind == "mjcf" else urdf(parameters, ros2_control=ros2_control, namespace=namespace)
    if output is None:
        typer.echo(text, nl=False)
        return
    with writing(f"model file {output}", ParameterError):
        write_whole(output, text)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m pendulum_sim export_model")
