"""``experiment joints``: the whole answer for a plant of several joints, held upright under noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_bags.commands.compare_cli import MarginOption, MarginsFile
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
from pendulum_bags.experiments.operator import ask_for_running
from pendulum_bags.experiments.plant_options import AcceptDifferences, AnySimulation, HardwareMapping, MappingFile
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.experiments.settings import MODEL_FILES, NoiseSettings
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.options import Domain, Json, Storage, Yes, out_option
from pendulum_sim.simulator.engines import GYMNASIUM_PREFIX

if TYPE_CHECKING:
    from pendulum_bags.whole.carry_out import Order

__all__ = ["joints"]


def joints(
    out: Annotated[
        Path | None,
        out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_joints."),
    ] = None,
    plant: Annotated[
        str, typer.Option(help="Preset or plant file of several joints: simulated, and designed on.")
    ] = "cart_pole",
    simulation: AnySimulation = "",
    mapping: MappingFile = None,
    accept_differences: AcceptDifferences = False,
    hardware: Annotated[
        str,
        typer.Option(
            help="Preset or plant file of the emulated machine; emulator for one that --share and --delay draw. Or a "
            "second simulation: a model file or gymnasium:ID. Or ros:/NAMESPACE for a plant that runs already on "
            "--domain, and that a person holds upright."
        ),
    ] = "emulator",
    hardware_mapping: HardwareMapping = None,
    yes: Yes = False,
    domain: Domain = None,
    share: Annotated[
        float, typer.Option(help="Largest share by which its masses, lengths, inertias and friction are off.")
    ] = 0.05,
    delay: Annotated[float, typer.Option(help="Transport delay of its motors [s].")] = 0.004,
    joint: Annotated[str, typer.Option(help="Driven joint that has the noise; by default the first.")] = "",
    seed: Annotated[int, typer.Option(help="Seed of the noise, and of the draw.", min=0)] = 1,
    amplitude: Annotated[
        float | None,
        typer.Option(help="Largest effort of the noise [N m or N]; by default a tenth of the joint's effort limit."),
    ] = None,
    hold_time: Annotated[float, typer.Option(help="Time for which a noise sample is held [s].")] = 0.01,
    duration: Annotated[float, typer.Option(help="Length of the noise [s].")] = 20.0,
    controller: Annotated[
        str,
        typer.Option(
            help="What holds it under the noise: lqr, discrete_lqr, lqi, lqg, or mpc, which knows limits of efforts "
            "and of a track. Frequencies are those of an LQR."
        ),
    ] = "lqr",
    storage: Storage = "mcap",
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
    """Hold a plant of several joints upright under noise, simulated and as emulated hardware: is the simulation enough?

    The bridge drives the emulated hardware: quasi-direct drives, encoders and delays on a plant that is a little off.
    One controller, designed on the simulated plant, holds both, in lockstep; there the dry friction of a passive joint
    counts as viscous: else acrobot and pendubot would fall. Then it continues as the experiment thesis does: new noise
    until the first layer is decided, identification, and the other layers of both plants, until the budget is spent.
    Frequencies are measured where one joint is driven. A model file on either side has the joints of --plant, which
    is its equation, by name or in order. A plant that runs already is armed once it is held upright and still, balanced
    for the length of the noise, and disarmed: it falls.

    Example: python -m pendulum_bags experiment joints --plant acrobot --share 0.1
    """
    from pendulum_bags.comparison import Margins
    from pendulum_bags.experiments.held import RELEASE_TIME
    from pendulum_bags.experiments.joint_run import (
        JointSettings,
        default_amplitude,
        design_file,
        design_for,
        load_surrogate,
        surrogate_for,
    )
    from pendulum_bags.frequency_response.designs import read_designs
    from pendulum_bags.frequency_response.multisine import Multisine
    from pendulum_bags.runs.next_test import MACHINE_FILE
    from pendulum_bags.whole.carry_out import Order
    from pendulum_lqr.linear.model import linearise
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism, write_plant

    if amplitude is None:
        amplitude = default_amplitude(plant, joint)
    by_name = hardware.startswith((GRAPH_PREFIX, GYMNASIUM_PREFIX)) or hardware == "hebi"
    is_drawn, is_other = hardware == "emulator", by_name or Path(hardware).suffix.lower() in MODEL_FILES
    settings = JointSettings(
        plant,
        joint=joint,
        noise=NoiseSettings(seed, amplitude, hold_time, duration),
        storage=storage,
        controller=controller,
        simulation=simulation,
        mapping=str(mapping or ""),
        hardware=hardware if is_other else "emulator",
        hardware_mapping=str(hardware_mapping or ""),
    )
    simulated = load_mechanism(plant)
    machine = None
    if is_drawn:
        machine = surrogate_for(simulated, share=share, delay=delay, seed=seed)
    elif not is_other:
        machine = load_surrogate(hardware, simulated)
    foreign, domain = settings.foreign, check_domain(domain)
    if foreign is not None and not accept_differences:
        foreign.require_equation()
    driven = len(simulated.coordinates.driven)
    if design and driven != 1:
        raise ParameterError(f"--design is for a plant with one driven joint; {simulated.name} has {driven}")
    if design:
        # Checked before anything runs.
        on = design_for(simulated)
        read_designs(design, on, linearise(on))
    budget = budget_of(budget, contenders, seeds, joints=True)
    margins, steps = Margins.of(margins_file, margin), steps_of(only, budget)

    if running := [settings.namespace(side) for side in SIDES if settings.running(side) is not None]:
        if domain is None:
            raise ParameterError(f"plant {running[0]} runs on a ROS domain; expected --domain N, or ROS_DOMAIN_ID")
        unit = simulated.coordinates.drive_unit
        plan = (
            f"It waits until you hold the plant upright and still, arms, and balances it: release it within "
            f"{RELEASE_TIME:g} s. Then noise of up to {amplitude:g} {unit} acts at {settings.joint} for "
            f"{duration:g} s, it disarms, and the plant FALLS."
        )
        ask_for_running(running, domain, plan, yes=yes)

    def order_in(folder: Path) -> Order:
        file = ""
        if machine is not None:
            why = {"stands_in_for": f"the machine of {plant}"}
            file = str(write_plant(folder / MACHINE_FILE, machine, provenance=why))
        if foreign is not None:
            foreign.write_equation(folder)
        of = replace(settings, machine=file, design=design_file(folder, plant))
        multisine = Multisine(signal_period=signal_period, periods=periods)
        return Order(of, margins, budget, steps, contenders, seeds, domain, multisine, design or ())

    drawn = f": values of {plant} off by up to {100.0 * share:g} %, {1e3 * delay:g} ms of delay"
    emulated = f"The emulated hardware is the bridge on an emulated machine of {{0}}{drawn if is_drawn else ''}."
    run_whole(
        out,
        "joints",
        order_in,
        json_output=json_output,
        remark=lambda folder: "" if machine is None else emulated.format(folder / MACHINE_FILE),
    )
