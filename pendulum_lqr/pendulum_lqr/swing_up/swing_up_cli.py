"""``python -m pendulum_lqr swing_up``: search a swing-up for a plant of several joints, and store it."""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # before anything that imports numpy
# isort: on

from pathlib import Path
from typing import Annotated

import typer

from pendulum_lqr.swing_up.ilqr import IlqrWeights, require_several_joints
from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.counted_progress import counting_bar
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["main"]

_WEIGHTS = "0.15,0.0447,0.143,0.00137,0.00655,10"


def swing_up(
    preset: Annotated[str, typer.Option(help="Preset or plant file of several joints.")] = "acrobot_frictionless",
    weights: Annotated[
        str, typer.Option(help=f"Weights of {', '.join(IlqrWeights._fields)}. The default is the benchmark's score v2.")
    ] = _WEIGHTS,
    first: Annotated[int, typer.Option(help="First seed of the random guesses.", min=0)] = 0,
    guesses: Annotated[int, typer.Option(help="Random guesses; the cheapest that ends upright is kept.", min=1)] = 100,
    duration: Annotated[float, typer.Option(help="Length of the trajectory [s].", min=0.5)] = 4.0,
    output: Annotated[Path, out_option("File to write (JSON).")] = Path("build/swing_up.json"),
) -> None:
    """Search a swing-up by iterative LQR from random guesses: half a second each, some ten seconds of compiling before.

    Example: python -m pendulum_lqr swing_up --preset pendubot_frictionless --guesses 20 --out build/pendubot.json
    """
    from pendulum_lqr.swing_up.stored_swing_up import default_catch
    from pendulum_lqr.swing_up.trajectory import SwingUpSearch, cheapest_swing_up, write_trajectory
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism

    plant = load_mechanism(preset)
    require_several_joints(plant)
    try:
        values = IlqrWeights(*(float(part) for part in weights.split(",")))
    except (TypeError, ValueError) as error:
        raise ParameterError(
            f"--weights is {weights!r}; expected {len(IlqrWeights._fields)} numbers, for "
            f"{', '.join(IlqrWeights._fields)}"
        ) from error
    with writing(f"trajectory {output}", ParameterError):
        output.parent.mkdir(parents=True, exist_ok=True)
    catch = default_catch(plant.torque_plant)
    search = SwingUpSearch(values, duration=duration)
    console = make_console(highlight=False)
    with counting_bar(console) as bar:
        seeds = bar.track(range(first, first + guesses), description="guesses")
        best, upright = cheapest_swing_up(catch, search, seeds)
    write_trajectory(output, best)
    console.print(f"{upright} of {guesses} guesses end upright; seed {best.how['seed']} costs {best.how['cost']:.4f}")
    console.print(f"trajectory {output}", soft_wrap=True)


main = command_line(swing_up, "python -m pendulum_lqr swing_up")
