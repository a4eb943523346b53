"""``experiment inertia_damping`` and ``experiment gravity``: from the first process to the thesis's coefficients."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from pendulum_bags.experiments.domain import check_domain
from pendulum_bags.experiments.new_run import new_run
from pendulum_bags.experiments.operator import confirmed
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.programs.options import Domain, Json, Lab, Storage, Yes, out_option
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_msgs_py.programs.typed_commands import as_typed

if TYPE_CHECKING:
    from pendulum_bags.experiments.trials import TrialSettings

__all__ = ["add_commands"]

Out = Annotated[Path | None, out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_<experiment>.")]
Hardware = Annotated[str, typer.Option(help="emulator, or hebi for the real actuator.")]
Plant = Annotated[str, typer.Option(help="What the emulator is: preset or plant file with a drivetrain.")]
Realtime = Annotated[bool, typer.Option(help="Keep the wall's time on the emulator too, instead of lockstep.")]
Seed = Annotated[int, typer.Option(help="Seed of the emulator's sensor noise and of the simulated hand.", min=0)]
Trials = Annotated[int, typer.Option(help="Number of trials, one bag each.", min=1, max=100)]


def add_commands(app: typer.Typer) -> None:
    """Add the two experiments to the command line of ``experiment``."""
    app.command(name="inertia_damping")(inertia_damping)
    app.command(name="gravity")(gravity)


def inertia_damping(
    out: Out = None,
    hardware: Hardware = "emulator",
    lab: Lab = None,
    yes: Yes = False,
    plant: Plant = "thesis",
    realtime: Realtime = False,
    seed: Seed = 1,
    trials: Trials = 6,
    storage: Storage = "mcap",
    domain: Domain = None,
    json_output: Json = False,
) -> None:
    """Turn the flat pendulum by hand at zero PWM, six times, and regress effort on velocity and acceleration.

    With --hardware hebi, a person turns it, prompted by this terminal; on the emulator a simulated hand does.

    Example: python -m pendulum_bags experiment inertia_damping --out /tmp/hand
    """
    from pendulum_bags.experiments.trials import INERTIA_DAMPING, TrialSettings

    settings = TrialSettings(
        INERTIA_DAMPING, trials, hardware, plant, realtime, seed, storage=storage, lab=str(lab or "")
    )
    _run(settings, out, domain, json_output, yes=yes)


def gravity(
    out: Out = None,
    hardware: Hardware = "emulator",
    lab: Lab = None,
    yes: Yes = False,
    plant: Plant = "thesis",
    realtime: Realtime = False,
    seed: Seed = 1,
    trials: Trials = 3,
    step: Annotated[float, typer.Option(help="Height of a step [deg].", min=1.0, max=90.0)] = 10.0,
    top: Annotated[float, typer.Option(help="Highest angle, a multiple of the step [deg].", min=1.0)] = 90.0,
    hold: Annotated[float, typer.Option(help="Time at rest on each step [s].", min=0.5, max=60.0)] = 2.0,
    storage: Storage = "mcap",
    domain: Domain = None,
    json_output: Json = False,
) -> None:
    """Climb a staircase against gravity, 0 to 90 degrees, to -90 and back, and regress effort on sin(theta).

    Example: python -m pendulum_bags experiment gravity --out /tmp/stairs
    """
    from pendulum_bags.experiments.trials import GRAVITY, TrialSettings

    settings = TrialSettings(GRAVITY, trials, hardware, plant, realtime, seed, step, top, hold, storage, str(lab or ""))
    _run(settings, out, domain, json_output, yes=yes)


def _run(settings: TrialSettings, out: Path | None, domain: int | None, json_output: bool, *, yes: bool) -> None:
    from pendulum_bags.commands import identify_cli
    from pendulum_bags.experiments.trials import run_trials

    # Checked before the machine moves.
    if importlib.util.find_spec("statsmodels") is None:
        raise ModuleNotFoundError("No module named 'statsmodels'", name="statsmodels")
    check_domain(domain)
    name = settings.kind.name
    console = make_console(stderr=json_output, highlight=False)
    program, plan = settings.plant_program(1), _plan(settings)
    ended = "the drive is off, all programs have ended"
    with (
        confirmed(settings.machine, program, plan, yes=yes, flat=settings.kind.flat),
        new_run(out, name, console, ended=ended, recorded="what was recorded until then") as folder,
    ):
        started = time.monotonic()
        with PhaseProgress(settings.trials * settings.expected_wall_time, console) as progress:
            bags = run_trials(folder, settings, domain, progress, ask=lambda sentence: _ask(console, sentence))
    elapsed = time.monotonic() - started
    arguments = ["--method", "thesis", "--experiment", name, "--out", str(folder / "identified.json")]
    code = identify_cli.main([*map(str, bags), *arguments, *(["--json"] if json_output else [])])
    console.print(
        f"\nbags    {folder / 'trial_1'} to {folder / f'trial_{len(bags)}'} ({elapsed:.0f} s)\n"
        + as_typed(f"again   python -m pendulum_bags identify {folder}/trial_* --method thesis --experiment {name}"),
        soft_wrap=True,
    )
    if code:
        raise typer.Exit(code)


def _plan(settings: TrialSettings) -> str:
    if settings.by_person:
        return (
            f"It arms {settings.trials} times with zero torque; a person turns the link, which lies flat, by hand. "
            "The motor only brakes."
        )
    return (
        f"It arms {settings.trials} times and follows a staircase of {settings.step:g} degrees to {settings.top:g}, to "
        f"-{settings.top:g} and back, about {settings.expected_duration:.0f} s each."
    )


def _ask(console: Console, sentence: str) -> None:
    """Show a sentence and wait for Enter, if there is a terminal; a PendulumError if the input has ended."""
    console.print(sentence)
    try:
        input()
    except EOFError:
        raise PendulumError("a person is needed for this experiment; expected a terminal to press Enter on") from None
