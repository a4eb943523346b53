"""``experiment joints``: the whole answer for a plant of several joints, held upright under noise."""

from __future__ import annotations

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
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.options import Json, Storage, out_option

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
    hardware: Annotated[
        str,
        typer.Option(
            help="Preset or plant file of the emulated machine; emulator for one that --share and --delay draw."
        ),
    ] = "emulator",
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
    counts as viscous: else acrobot and pendubot would fall. Then it goes on as the experiment thesis does: new noise
    until the first layer is decided, identification, and the other layers of both plants, until the budget is spent.
    Frequencies are measured where one joint is driven.

    Example: python -m pendulum_bags experiment joints --plant acrobot --share 0.1
    """
    from pendulum_bags.comparison import Margins
    from pendulum_bags.experiments.joint_run import (
        JointSettings,
        default_amplitude,
        design_file,
        design_for,
        load_surrogate,
        surrogate_for,
    )
    from pendulum_bags.experiments.settings import NoiseSettings
    from pendulum_bags.frequency_response.designs import read_designs
    from pendulum_bags.frequency_response.multisine import Multisine
    from pendulum_bags.runs.next_test import MACHINE_FILE
    from pendulum_bags.whole.carry_out import Order
    from pendulum_lqr.linear.model import linearise
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism, write_plant

    if amplitude is None:
        amplitude = default_amplitude(plant, joint)
    settings = JointSettings(
        plant,
        joint=joint,
        noise=NoiseSettings(seed, amplitude, hold_time, duration),
        storage=storage,
        controller=controller,
    )
    simulated = load_mechanism(plant)
    is_drawn = hardware == "emulator"
    machine = (
        surrogate_for(simulated, share=share, delay=delay, seed=seed)
        if is_drawn
        else load_surrogate(hardware, simulated)
    )
    driven = len(simulated.coordinates.driven)
    if design and driven != 1:
        raise ParameterError(f"--design is for a plant with one driven joint; {simulated.name} has {driven}")
    if design:
        # Before anything runs: a slip of the pen should not cost a minute.
        on = design_for(simulated)
        read_designs(design, on, linearise(on))
    budget = budget_of(budget, contenders, seeds, joints=True)
    margins, steps = Margins.of(margins_file, margin), steps_of(only, budget)

    def order_in(folder: Path) -> Order:
        file = write_plant(folder / MACHINE_FILE, machine, provenance={"stands_in_for": f"the machine of {plant}"})
        of = JointSettings(plant, str(file), design_file(folder, plant), joint, settings.noise, storage, controller)
        multisine = Multisine(signal_period=signal_period, periods=periods)
        return Order(of, margins, budget, steps, contenders, seeds, multisine=multisine, designs=design or ())

    drawn = f": values of {plant} off by up to {100.0 * share:g} %, {1e3 * delay:g} ms of delay"
    run_whole(
        out,
        "joints",
        order_in,
        json_output=json_output,
        remark=lambda folder: (
            f"The emulated hardware is the bridge on an emulated machine of {folder / MACHINE_FILE}"
            f"{drawn if is_drawn else ''}."
        ),
    )
