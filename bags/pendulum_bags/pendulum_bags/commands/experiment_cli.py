"""``experiment``: run an experiment, from the start of the plants to the report."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.commands.frequency_response_cli import experiment as frequency_response
from pendulum_bags.commands.leaderboard_cli import leaderboard
from pendulum_bags.commands.mechanism_benchmark_cli import benchmark
from pendulum_bags.commands.monte_carlo_cli import Q, R, monte_carlo
from pendulum_bags.commands.region_cli import region_of_attraction
from pendulum_bags.commands.study_cli import add_commands as add_study_commands
from pendulum_bags.commands.thesis_cli import OF_ONE_JOINT, Seed, thesis
from pendulum_bags.commands.trials_cli import add_commands as add_trial_commands
from pendulum_bags.experiments.graph_plant import PREFIX as GRAPH_PREFIX
from pendulum_bags.experiments.joint_run import JointSettings, default_amplitude, design_file
from pendulum_bags.experiments.plant_options import (
    AcceptDifferences,
    MappingFile,
    SimulatedPlant,
    Simulation,
    Strategy,
    equation_file,
)
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.experiments.session import refuse_existing
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import is_mechanism
from pendulum_msgs_py.programs.executables import cli_main, typed_options
from pendulum_msgs_py.programs.options import Domain, Storage, out_option

__all__ = ["app", "main"]

app = typer.Typer(
    help="Run an experiment: start the nodes, conduct, record, compare, report.\n\n"
    "Example: python -m pendulum_bags experiment thesis --seed 7",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)

app.command(name="thesis")(thesis)
app.command(
    name="joints",
    short_help="The same as thesis, by default of a cart-pole.",
    epilog="Example: python -m pendulum_bags experiment joints --plant acrobot --share 0.1",
)(thesis)


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
    amplitude: Annotated[float, typer.Option(help="Largest torque of the noise [N m].")] = 2.5,
    hold_time: Annotated[
        float | None,
        typer.Option(help="Time for which a noise sample is held [s]; by default the plant's period."),
    ] = None,
    duration: Annotated[float, typer.Option(help="Length of the noise [s].")] = 5.0,
    controller: Annotated[str, typer.Option(help="Kind of controller, or a policy file (.npz).")] = "lqr",
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
        if typed := typed_options(context, OF_ONE_JOINT):
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


main = partial(cli_main, app, name="python -m pendulum_bags experiment")
