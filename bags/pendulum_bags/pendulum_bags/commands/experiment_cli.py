"""``experiment``: run an experiment, from the start of the plants to the report."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_bags.commands.compare_cli import MarginOption, MarginsFile
from pendulum_bags.commands.frequency_response_cli import experiment as frequency_response
from pendulum_bags.commands.joints_cli import joints
from pendulum_bags.commands.leaderboard_cli import leaderboard
from pendulum_bags.commands.mechanism_benchmark_cli import benchmark
from pendulum_bags.commands.monte_carlo_cli import Q, R, monte_carlo
from pendulum_bags.commands.region_cli import region_of_attraction
from pendulum_bags.commands.study_cli import add_commands as add_study_commands
from pendulum_bags.commands.trials_cli import add_commands as add_trial_commands
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
from pendulum_bags.experiments.joint_run import JointSettings, default_amplitude, design_file
from pendulum_bags.experiments.operator import ask_for_running, confirmed
from pendulum_bags.experiments.plant_options import (
    AcceptDifferences,
    AnySimulation,
    HardwareMapping,
    MappingFile,
    SimulatedPlant,
    Simulation,
    Strategy,
    equation_file,
)
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.experiments.session import refuse_existing
from pendulum_bags.experiments.settings import (
    RAMP_SPEED,
    SETTLE_TIME,
    NoiseSettings,
    RegulationSettings,
)
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import is_mechanism
from pendulum_msgs_py.programs.executables import cli_main, typed_options
from pendulum_msgs_py.programs.options import Domain, Json, Lab, Storage, Yes, out_option

if TYPE_CHECKING:
    from pendulum_bags.whole.carry_out import Order

__all__ = ["app", "main"]

app = typer.Typer(
    help="Run an experiment: start the nodes, conduct, record, compare, report.\n\n"
    "Example: python -m pendulum_bags experiment thesis --seed 7",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)

Seed = Annotated[int, typer.Option(help="Seed of the noise; one seed is one signal.", min=0)]
Amplitude = Annotated[float, typer.Option(help="Largest torque of the noise [N m].")]
HoldTime = Annotated[float, typer.Option(help="Time for which a noise sample is held [s].")]
Duration = Annotated[float, typer.Option(help="Length of the noise [s].")]
Controller = Annotated[str, typer.Option(help="Kind of controller, or a policy file (.npz).")]


_OF_SEVERAL_JOINTS = {"duration", "amplitude", "hold_time", "controller", "hardware"}
"""Options of ``thesis`` whose defaults are others for several joints."""
_OF_ONE_JOINT = {"lab", "strategy", "q", "r", "ramp_speed"}
"""Options of ``thesis`` that plants of several joints do not have."""


@app.command()
def thesis(
    context: typer.Context,
    out: Annotated[
        Path | None,
        out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_thesis."),
    ] = None,
    plant: SimulatedPlant = None,
    simulation: AnySimulation = "",
    mapping: MappingFile = None,
    accept_differences: AcceptDifferences = False,
    hardware: Annotated[
        str,
        typer.Option(
            help="emulator, or hebi for the real actuator. Or a second simulation to compare the first with: a model "
            "file or gymnasium:ID. Or ros:/NAMESPACE for a plant that runs already on --domain."
        ),
    ] = "emulator",
    hardware_mapping: HardwareMapping = None,
    lab: Lab = None,
    yes: Yes = False,
    strategy: Annotated[
        str | None,
        typer.Option(help="How the actuator turns wanted torque into PWM; default direct_pwm, or as in the lab file."),
    ] = None,
    seed: Seed = 1,
    amplitude: Amplitude = 2.5,
    hold_time: HoldTime = 0.01,
    duration: Duration = 5.0,
    ramp_speed: Annotated[
        float,
        typer.Option(
            help="Mean speed of the ramps up and down, 0.05 to 0.8; the largest is half as much again. Less than the "
            "thesis's 0.2 for a machine that may not turn so fast, more where the torque suffices [rad/s]."
        ),
    ] = RAMP_SPEED,
    controller: Controller = "lqr",
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
    """Regulate the upright pendulum under noise on simulator and hardware: is the simulation good enough?

    On the emulator it repeats the run with new noise until the first layer is yes or no, identifies a plant if that is
    no, and measures the other layers of both plants, until the budget is spent. Ctrl-C ends it with the answer so far.
    With a plant of several joints, such as acrobot, it is the experiment joints.

    Example: python -m pendulum_bags experiment thesis --out /tmp/my_run --seed 7 --margin delay=8ms
    """
    from pendulum_bags.comparison import Margins
    from pendulum_bags.frequency_response.multisine import Multisine
    from pendulum_bags.whole.carry_out import Order

    if plant is not None and is_mechanism(plant):
        if typed := typed_options(context, _OF_ONE_JOINT):
            raise ParameterError(
                f"{typed[0]} is for a plant of one joint, and {plant} has several; see python -m pendulum_bags "
                "experiment joints --help"
            )
        chosen = {name: context.params[name] for name in _OF_SEVERAL_JOINTS if typed_options(context, {name})}
        joints(
            out,
            plant,
            simulation=simulation,
            mapping=mapping,
            accept_differences=accept_differences,
            hardware_mapping=hardware_mapping,
            yes=yes,
            domain=domain,
            seed=seed,
            storage=storage,
            margin=margin,
            margins_file=margins_file,
            budget=budget,
            only=only,
            contenders=contenders,
            seeds=seeds,
            periods=periods,
            signal_period=signal_period,
            design=design,
            json_output=json_output,
            **chosen,
        )
        return
    settings = RegulationSettings(
        plant=plant or "thesis",
        simulation=simulation,
        mapping=str(mapping or ""),
        hardware=hardware,
        hardware_mapping=str(hardware_mapping or ""),
        effort_strategy=strategy or "",
        controller=controller,
        q=q,
        r=r,
        noise=NoiseSettings(seed, amplitude, hold_time, duration),
        storage=storage,
        lab=str(lab or ""),
        ramp_speed=ramp_speed,
    )
    margins = Margins.of(margins_file, margin)
    budget = budget_of(budget, contenders, seeds)
    steps = steps_of(only, budget)
    domain = check_domain(domain)
    if (foreign := settings.foreign) is not None and plant is None and not accept_differences:
        foreign.require_equation()
    multisine = Multisine(signal_period=signal_period, periods=periods, lowest=1.0 / signal_period)
    running = _running(settings, domain, plant)
    ask_for_running(running, domain or 0, _plan(settings), yes=yes)

    def order_in(folder: Path) -> Order:
        of = settings
        if foreign is not None:
            equation = foreign.write_equation(folder)
            of = settings if plant else replace(settings, plant=str(equation))
        return Order(of, margins, budget, steps, contenders, seeds, domain, multisine, design or ())

    with confirmed(settings.machine, settings.bridge_program(), _plan(settings), yes=yes):
        run_whole(out, "thesis", order_in, json_output=json_output)


@app.command()
def lockstep(
    context: typer.Context,
    bag: Annotated[Path, typer.Option(help="Folder of the bag; it must not exist.")],
    side: Annotated[str, typer.Option(help="sim for the simulator, hw for the emulated hardware.")] = "sim",
    plant: SimulatedPlant = None,
    simulation: Simulation = "",
    mapping: MappingFile = None,
    accept_differences: AcceptDifferences = False,
    strategy: Strategy = "direct_pwm",
    seed: Seed = 1,
    amplitude: Amplitude = 2.5,
    hold_time: Annotated[
        float | None,
        typer.Option(help="Time for which a noise sample is held [s]; by default the plant's period."),
    ] = None,
    duration: Duration = 5.0,
    controller: Controller = "lqr",
    q: Q = (100.0, 0.01),
    r: R = 0.1,
    storage: Storage = "mcap",
    domain: Domain = None,
) -> None:
    """Record one plant under control and noise, as fast as the loop allows; two runs with one seed are identical.

    Of several joints the emulated hardware (--side hw) has the values of --plant, and the noise is by default a tenth
    of the first motor's limit.

    Example: python -m pendulum_bags experiment lockstep --bag /tmp/seed_7 --seed 7
    """
    from pendulum_bags.experiments.host_pool import shared_pool
    from pendulum_bags.experiments.lockstep import run_lockstep

    if side not in {"sim", "hw"}:
        raise ParameterError(f"side is {side!r}; expected sim or hw")
    if simulation.startswith(GRAPH_PREFIX):
        raise ParameterError(
            f"simulation is {simulation}, which runs already; expected one that this command starts, in its own time"
        )
    settings: RegulationSettings | JointSettings
    if plant is not None and is_mechanism(plant):
        if typed := typed_options(context, _OF_ONE_JOINT):
            raise ParameterError(f"{typed[0]} is for a plant of one joint, and {plant} has several")
        largest = amplitude if typed_options(context, {"amplitude"}) else default_amplitude(plant)
        settings = JointSettings(
            plant,
            noise=NoiseSettings(seed, largest, hold_time or 0.01, duration),
            storage=storage,
            controller=controller,
            simulation=simulation,
            mapping=str(mapping or ""),
        )
        if settings.foreign is not None and not accept_differences:
            settings.foreign.require_equation()
        refuse_existing(bag)
        settings = replace(settings, design=design_file(bag.parent / "logs" / bag.name, plant))
    else:
        settings = RegulationSettings(
            plant=plant or "thesis",
            simulation=simulation,
            mapping=str(mapping or ""),
            effort_strategy=strategy,
            controller=controller,
            q=q,
            r=r,
            noise=NoiseSettings(seed, amplitude, hold_time or (0.002 if side == "sim" else 0.01), duration),
            storage=storage,
        )
    if plant is None and (made := equation_file(settings.foreign, bag, accept_differences=accept_differences)):
        refuse_existing(bag)
        settings = replace(settings, plant=made)
    started = time.monotonic()
    run_lockstep(bag, settings, side=side, domain=domain, hosts=shared_pool())
    elapsed = time.monotonic() - started
    print(f"{bag}: {duration:g} s simulated in {elapsed:.1f} s, starting the nodes included", file=sys.stderr)


add_trial_commands(app)
add_study_commands(app)
app.command(name="monte_carlo")(monte_carlo)
app.command(name="region_of_attraction")(region_of_attraction)
app.command(name="leaderboard")(leaderboard)
app.command(name="benchmark")(benchmark)
app.command(name="frequency_response")(frequency_response)
app.command(name="joints")(joints)


@app.command()
def examples(
    out: Annotated[Path, out_option("Folder for the recordings.")] = Path("bags", "examples"),
) -> None:
    """Record the project's small recordings again, in lockstep.

    Example: python -m pendulum_bags experiment examples --out bags/examples
    """
    from pendulum_bags.experiments.lockstep import run_lockstep

    # Runs are reproducible: a changed example shows changed programs.
    settings = RegulationSettings(noise=NoiseSettings(seed=1, hold_time=0.01))
    out.mkdir(parents=True, exist_ok=True)
    for side in SIDES:
        with tempfile.TemporaryDirectory(prefix="pendulum_examples_") as scratch:
            target = out / f"regulation_{side}"
            recorded = run_lockstep(Path(scratch) / target.name, settings, side=side)
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(recorded, target)
            print(target)


def _running(settings: RegulationSettings, domain: int | None, plant: str | None) -> list[str]:
    """Return the namespaces of plants that run already, if the rest of the command line fits them."""
    found = [settings.namespace(side) for side in SIDES if settings.running(side) is not None]
    if found and domain is None:
        raise ParameterError(f"plant {found[0]} runs on a ROS domain; expected --domain N, or ROS_DOMAIN_ID")
    if settings.running("sim") is not None and plant is None:
        raise ParameterError(
            f"simulation {settings.simulation} does not state its equation; expected --plant FILE, on which the "
            "controller is designed"
        )
    return found


def _plan(settings: RegulationSettings) -> str:
    noise = settings.noise
    return (
        f"It arms, turns the pendulum upright in about {settings.ramp_time:.0f} s, balances it for "
        f"{SETTLE_TIME + noise.duration:g} s under noise of up to {noise.amplitude:g} N m, turns it down again in "
        f"about {settings.ramp_time:.0f} s, and disarms."
    )


main = partial(cli_main, app, name="python -m pendulum_bags experiment")
