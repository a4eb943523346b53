"""``experiment thesis``, and ``experiment joints``: the whole answer for a plant held upright under noise."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pendulum_bags.commands.compare_cli import MarginOption, MarginsFile
from pendulum_bags.commands.monte_carlo_cli import Q, R
from pendulum_bags.commands.whole_run import (
    Budget,
    Contenders,
    Design,
    Only,
    Periods,
    Seeds,
    SignalPeriod,
    budget_of,
    run_whole,
    steps_of,
)
from pendulum_bags.experiments.domain import check_domain
from pendulum_bags.experiments.graph_plant import PREFIX as GRAPH_PREFIX
from pendulum_bags.experiments.joint_run import (
    DURATION,
    JointSettings,
    default_amplitude,
    design_file,
    design_for,
    load_surrogate,
    surrogate_for,
)
from pendulum_bags.experiments.operator import ask_for_running, confirmed, real_machine
from pendulum_bags.experiments.plant_options import AcceptDifferences, AnySimulation, HardwareMapping, MappingFile
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.experiments.settings import (
    MODEL_FILES,
    RAMP_SPEED,
    SETTLE_TIME,
    NoiseSettings,
    RegulationSettings,
    is_named,
    usual_of_drive,
)
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import is_mechanism, load_mechanism, write_plant
from pendulum_msgs_py.programs.executables import typed_options
from pendulum_msgs_py.programs.options import Domain, Json, Lab, Storage, Yes, out_option
from pendulum_sim.simulator.engines import GYMNASIUM_PREFIX

if TYPE_CHECKING:
    from pendulum_bags.whole.carry_out import Order
    from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["OF_ONE_JOINT", "Seed", "thesis"]

Seed = Annotated[int, typer.Option(help="Seed of the noise; one seed is one signal.", min=0)]

OF_ONE_JOINT = {"lab", "strategy", "q", "r", "ramp_speed"}
"""Options that plants of several joints do not have."""
_OF_SEVERAL_JOINTS = {"share", "delay", "joint"}
"""Options that plants of one joint do not have."""


def thesis(
    context: typer.Context,
    out: Annotated[
        Path | None,
        out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_thesis, or _joints."),
    ] = None,
    plant: Annotated[
        str | None,
        typer.Option(
            help="Preset or plant file of the simulated plant, and of the controller's design; default thesis "
            "(experiment joints: cart_pole), or with --simulation the equation read off it."
        ),
    ] = None,
    simulation: AnySimulation = "",
    mapping: MappingFile = None,
    accept_differences: AcceptDifferences = False,
    hardware: Annotated[
        str,
        typer.Option(
            help="emulator, or hebi for the real actuator, or dynamixel:PORT. Or a second simulation to compare the "
            "first with: a model file or gymnasium:ID. Or ros:/NAMESPACE for a plant that runs already on --domain. "
            "With several joints also a preset or plant file of the emulated machine; emulator is one that --share and "
            "--delay draw."
        ),
    ] = "emulator",
    hardware_mapping: HardwareMapping = None,
    lab: Lab = None,
    yes: Yes = False,
    strategy: Annotated[
        str | None,
        typer.Option(help="How the actuator turns wanted torque into PWM; default direct_pwm, or as in the lab file."),
    ] = None,
    share: Annotated[
        float,
        typer.Option(help="Of several joints: largest share by which masses, lengths, inertias and friction are off."),
    ] = 0.05,
    delay: Annotated[float, typer.Option(help="Of several joints: delay of the machine's motors [s].")] = 0.004,
    joint: Annotated[
        str, typer.Option(help="Of several joints: the driven joint that has the noise; by default the first.")
    ] = "",
    seed: Seed = 1,
    amplitude: Annotated[
        float | None,
        typer.Option(
            help="Largest torque of the noise; by default 2.5 N m, with several joints a tenth of the joint's "
            "limit, on a drive an eighth [N m or N]."
        ),
    ] = None,
    hold_time: Annotated[float, typer.Option(help="Time for which a noise sample is held [s].")] = 0.01,
    duration: Annotated[
        float | None, typer.Option(help="Length of the noise; by default 5, with several joints 20 [s].")
    ] = None,
    ramp_speed: Annotated[
        float,
        typer.Option(
            help="Mean speed of the ramps up and down, 0.05 to 0.8; the largest is half as much again. Less than the "
            "thesis's 0.2 for a machine that may not turn so fast, more where the torque suffices [rad/s]."
        ),
    ] = RAMP_SPEED,
    controller: Annotated[
        str,
        typer.Option(
            help="Kind of controller, or a policy (.npz). With several joints lqr, discrete_lqr, lqi, lqg, or mpc, "
            "which knows limits of efforts and of a track; frequencies are those of an LQR."
        ),
    ] = "lqr",
    q: Q = (100.0, 0.01),
    r: R = 0.1,
    storage: Storage = "mcap",
    domain: Domain = None,
    margin: MarginOption = None,
    margins_file: MarginsFile = None,
    budget: Budget = None,
    only: Only = None,
    contenders: Contenders = 6,
    seeds: Seeds = 3,
    periods: Periods = 8,
    signal_period: SignalPeriod = 4.0,
    design: Design = None,
    json_output: Json = False,
) -> None:
    """Regulate an upright plant under noise on simulator and hardware: is the simulation good enough?

    On emulated hardware it repeats the run with new noise until the first layer is yes or no, identifies a plant if
    that is no, and measures the other layers of both plants, until the budget is spent. Ctrl-C ends it with the answer
    so far.

    With several joints, such as acrobot, the bridge drives quasi-direct drives, encoders and delays on a plant that is
    a little off, in lockstep. One controller, designed on the simulated plant, holds both; there the dry friction of a
    passive joint counts as viscous: else acrobot and pendubot would fall. Frequencies are measured where one joint is
    driven. A model file on either side has the joints of --plant, which is its equation, by name or in order. A plant
    that runs already is armed once it is held upright and still, balanced for the length of the noise, and disarmed: it
    falls.

    Example: python -m pendulum_bags experiment thesis --out /tmp/my_run --seed 7 --margin delay=8ms
    """
    from pendulum_bags.comparison import Margins
    from pendulum_bags.frequency_response.multisine import Multisine
    from pendulum_bags.whole.carry_out import Order

    several = is_mechanism(plant) if plant else context.info_name == "joints"
    given = plant or ("cart_pole" if several else "")
    if typed := typed_options(context, OF_ONE_JOINT if several else _OF_SEVERAL_JOINTS):
        one, other = ("one joint", "several") if several else ("several joints", "one")
        raise ParameterError(f"{typed[0]} is for a plant of {one}, and {given or 'thesis'} has {other}")
    sides: dict[str, Any] = {
        "simulation": simulation,
        "mapping": str(mapping or ""),
        "hardware_mapping": str(hardware_mapping or ""),
        "controller": controller,
        "storage": storage,
    }
    settings: RegulationSettings | JointSettings
    machine = None
    if several:
        largest = default_amplitude(given, joint) if amplitude is None else amplitude
        noise = NoiseSettings(seed, largest, hold_time, DURATION if duration is None else duration)
        settings, machine = _of_joints(given, hardware, share, delay, joint=joint, noise=noise, **sides)
        if design:
            _check_design(design, given)
    else:
        usual, largest = "thesis", 2.5
        if (drive := real_machine(hardware, lab)) is not None and drive.is_drive:
            usual = str(drive.lab.values["plant"])
            largest, weight = usual_of_drive(given or usual, q[0])
            r = r if typed_options(context, {"r"}) else weight
        largest = largest if amplitude is None else amplitude
        noise = NoiseSettings(seed, largest, hold_time, 5.0 if duration is None else duration)
        own: dict[str, Any] = {
            "effort_strategy": strategy or "",
            "q": q,
            "r": r,
            "lab": str(lab or ""),
            "ramp_speed": ramp_speed,
        }
        settings = RegulationSettings(given or usual, hardware, noise=noise, **own, **sides)
    margins = Margins.of(margins_file, margin)
    budget = budget_of(budget, contenders, seeds, joints=several)
    steps = steps_of(only, budget)
    domain, foreign = check_domain(domain), settings.foreign
    if foreign is not None and (several or not given) and not accept_differences:
        foreign.require_equation()
    multisine = Multisine(signal_period=signal_period, periods=periods, lowest=1.0 / signal_period)
    running = _running(settings, domain, given)
    ask_for_running(running, domain or 0, _plan(settings), yes=yes)

    def order_in(folder: Path) -> Order:
        from pendulum_bags.runs.next_test import MACHINE_FILE

        of, equation = settings, "" if foreign is None else str(foreign.write_equation(folder))
        if isinstance(of, JointSettings):
            why = {"stands_in_for": f"the machine of {given}"}
            file = "" if machine is None else str(write_plant(folder / MACHINE_FILE, machine, provenance=why))
            of = replace(of, machine=file, design=design_file(folder, given))
        elif equation and not given:
            of = replace(of, plant=equation)
        return Order(of, margins, budget, steps, contenders, seeds, domain, multisine, design or ())

    def remark(folder: Path) -> str:
        from pendulum_bags.runs.next_test import MACHINE_FILE

        if machine is None:
            return ""
        off = f": values of {given} off by up to {100.0 * share:g} %, {1e3 * delay:g} ms of delay"
        drawn = off if hardware == "emulator" else ""
        return f"The emulated hardware is the bridge on an emulated machine of {folder / MACHINE_FILE}{drawn}."

    checked = (
        confirmed(settings.machine, settings.bridge_program(), _plan(settings), yes=yes)
        if isinstance(settings, RegulationSettings)
        else nullcontext()
    )
    with checked:
        run_whole(out, "joints" if several else "thesis", order_in, json_output=json_output, remark=remark)


def _of_joints(
    plant: str, hardware: str, share: float, delay: float, *, noise: NoiseSettings, **given: Any
) -> tuple[JointSettings, PlantParameters | None]:
    """Return the settings of a plant of several joints, and the plant of its emulated machine, if it has one."""
    by_name = hardware.startswith((GRAPH_PREFIX, GYMNASIUM_PREFIX)) or (is_named(hardware) and hardware != "emulator")
    is_other = by_name or Path(hardware).suffix.lower() in MODEL_FILES
    settings = JointSettings(plant, noise=noise, hardware=hardware if is_other else "emulator", **given)
    simulated = load_mechanism(plant)
    if hardware == "emulator":
        return settings, surrogate_for(simulated, share=share, delay=delay, seed=noise.seed)
    return settings, None if is_other else load_surrogate(hardware, simulated)


def _check_design(design: list[str], plant: str) -> None:
    """Refuse designs to certify before anything runs."""
    from pendulum_bags.frequency_response.designs import read_designs
    from pendulum_lqr.linear.model import linearise

    on = design_for(load_mechanism(plant))
    if (driven := len(on.coordinates.driven)) != 1:
        raise ParameterError(
            f"--design is for a plant with one driven joint; {load_mechanism(plant).name} has {driven}"
        )
    read_designs(design, on, linearise(on))


def _running(settings: RegulationSettings | JointSettings, domain: int | None, plant: str) -> list[str]:
    """Return the namespaces of plants that run already, if the rest of the command line fits them."""
    found = [settings.namespace(side) for side in SIDES if settings.running(side) is not None]
    if found and domain is None:
        raise ParameterError(f"plant {found[0]} runs on a ROS domain; expected --domain N, or ROS_DOMAIN_ID")
    if settings.running("sim") is not None and not plant:
        raise ParameterError(
            f"simulation {settings.simulation} does not state its equation; expected --plant FILE, on which the "
            "controller is designed"
        )
    return found


def _plan(settings: RegulationSettings | JointSettings) -> str:
    from pendulum_bags.experiments.held import RELEASE_TIME

    noise = settings.noise
    if isinstance(settings, JointSettings):
        unit = load_mechanism(settings.plant).coordinates.drive_unit
        return (
            f"It waits until you hold the plant upright and still, arms, and balances it: release it within "
            f"{RELEASE_TIME:g} s. Then noise of up to {noise.amplitude:g} {unit} acts at {settings.joint} for "
            f"{noise.duration:g} s, it disarms, and the plant FALLS."
        )
    return (
        f"It arms, turns the pendulum upright in about {settings.ramp_time:.0f} s, balances it for "
        f"{SETTLE_TIME + noise.duration:g} s under noise of up to {noise.amplitude:g} N m, turns it down again in "
        f"about {settings.ramp_time:.0f} s, and disarms."
    )
