"""``train``: train a policy file for a plant."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import TextColumn, TimeRemainingColumn

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counting_bar
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, command_line, typed_options
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_learning.training import Training

__all__ = ["main"]

_OF_SWING_UP = (
    "plant", "teacher", "share", "delay", "jitter", "angle_noise", "velocity_noise", "kick", "period", "history",
    "travel",
)  # fmt: skip
"""Options that Gymnasium's pendulum has no use for."""

_TAUGHT = {
    "period": 0.004, "share": 0.05, "delay": 0.0016, "jitter": 0.0004, "angle_noise": 2e-4, "velocity_noise": 0.005,
    "kick": 0.05,
}  # fmt: skip
_TAUGHT_OFFSET = 1e-3
"""What differs where a teacher is imitated, unless it is given: a swing-up's gains are high, and where plant and state
are poorly known there is no single command to learn."""


def train(
    context: typer.Context,
    out: Annotated[Path, out_option("Policy file (.npz); it must be new.")],
    plant: Annotated[
        str, typer.Option(help="Preset or plant file; intervals in the file widen what is trained on.")
    ] = "dfki",
    task: Annotated[
        str, typer.Option(help="swing_up: swing up and hold upright; pendulum_v1: Gymnasium's Pendulum-v1.")
    ] = "swing_up",
    teacher: Annotated[str, typer.Option(help="none, or tvlqr: imitate the stored swing-up of the plant.")] = "none",
    seed: Annotated[int, typer.Option(help="Seed; one seed is one file.", min=0)] = 1,
    updates: Annotated[int, typer.Option(help="Updates of the policy; 0 for as many as the task takes.", min=0)] = 0,
    share: Annotated[float, typer.Option(help="Half width of the range of each parameter, as a share.")] = 0.25,
    delay: Annotated[float, typer.Option(help="Longest mean delay from state to torque [s].")] = 0.008,
    jitter: Annotated[float, typer.Option(help="Standard deviation of the delay from command to command [s].")] = 0.001,
    angle_noise: Annotated[float, typer.Option(help="Standard deviation of measured angles [rad].")] = 1e-3,
    velocity_noise: Annotated[float, typer.Option(help="Standard deviation of measured velocities [rad/s].")] = 0.03,
    kick: Annotated[float, typer.Option(help="Largest kick, as a share of the torque limit.")] = 0.7,
    period: Annotated[float, typer.Option(help="Time between two commands [s].")] = 0.01,
    history: Annotated[int, typer.Option(help="Samples that the policy sees.")] = 3,
    travel: Annotated[float, typer.Option(help="Largest deviation of a joint that slides [m].")] = 0.4,
    hidden: Annotated[tuple[int, int], typer.Option(help="Widths of the hidden layers.")] = (64, 64),
    json_output: Json = False,
) -> None:
    """Train a policy for a plant: on plants, delays, noise and kicks drawn again for each episode.

    An interrupted training resumes with the same command; its checkpoint is next to the policy file.

    With --teacher tvlqr the defaults are others: period 0.004, delay 0.0016, jitter 0.0004, share 0.05, kick 0.05,
    angle noise 0.0002, velocity noise 0.005. Its policy knows the way up from hanging, and no other.

    Example: python -m pendulum_learning train --plant dfki --out build/dfki.npz

    Example: python -m pendulum_learning train --plant pendubot_frictionless --teacher tvlqr --out build/pendubot.npz
    """
    from pendulum_learning.task import SwingUpTask
    from pendulum_learning.training import checkpoint_path
    from pendulum_learning.training import train as train_policy

    if out.exists():
        raise ParameterError(f"policy file {out} exists; expected a new one")
    if min(hidden) < 1 or max(hidden) > 512:
        raise ParameterError(f"hidden is {hidden[0]} {hidden[1]}; expected widths of 1 to 512")
    if task == "pendulum_v1" and (ignored := typed_options(context, _OF_SWING_UP)):
        raise ParameterError(
            f"{', '.join(ignored)} is given, but the task pendulum_v1 is Gymnasium's own pendulum; "
            "expected no such option, or --task swing_up"
        )
    values = {
        "period": period, "share": share, "delay": delay, "jitter": jitter, "angle_noise": angle_noise,
        "velocity_noise": velocity_noise, "kick": kick,
    }  # fmt: skip
    offset = SwingUpTask.offset
    if teacher != "none":
        values |= {name: value for name, value in _TAUGHT.items() if not typed_options(context, (name,))}
        offset = _TAUGHT_OFFSET
    swing_up = SwingUpTask(history=history, travel=travel, offset=offset, **values)
    settings = _settings(task, plant, seed, updates, swing_up, hidden, teacher)
    console = make_console(stderr=json_output, highlight=False)
    began = time.monotonic()
    try:
        with counting_bar(console, TextColumn("{task.fields[status]}"), TimeRemainingColumn()) as bar:
            shown = bar.add_task("updates", total=settings.updates, status="compiling")

            def on_update(done: int, measured: Mapping[str, float]) -> None:
                bar.update(shown, completed=done, status=f"reward {measured['reward']:+.4f}")

            def on_trial(done: int, of: int) -> None:
                bar.update(shown, description="trials", completed=done, total=of, status="")

            policy, curves = train_policy(settings, out, on_update=on_update, on_trial=on_trial)
    except KeyboardInterrupt:
        checkpoint = checkpoint_path(out)
        there = f"the same command resumes from {checkpoint}" if checkpoint.exists() else "nothing was written"
        console.print(f"interrupted: {there}", soft_wrap=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    figure = _write_curves(out, settings, curves)
    measured: Mapping[str, Any] = policy.provenance["evaluation"]
    if json_output:
        print(json_text({"policy": str(out), "steps": settings.steps, **measured}))
        return
    console.print(_sentence(measured))
    console.print(f"policy  {out}\ncurves  {figure}\n({time.monotonic() - began:.0f} s)", soft_wrap=True)


def _settings(
    task: str, plant: str, seed: int, updates: int, swing_up: Any, hidden: tuple[int, int], teacher: str = "none"
) -> Training:
    from pendulum_learning.ppo import PpoSettings
    from pendulum_learning.training import Training
    from pendulum_msgs_py.plants.plant_parameters import load_plant_file

    if task == "pendulum_v1":
        ppo = PpoSettings(hidden=hidden, discount=0.95, epochs=8, batches=8)
        settings = Training(task=task, swing_up=swing_up, ppo=ppo, environments=256, updates=80, seed=seed)
    else:
        parameters, provenance = load_plant_file(plant)
        settings = Training(
            task=task, plant=parameters, intervals=provenance["intervals"], swing_up=swing_up,
            ppo=PpoSettings(hidden=hidden), seed=seed, teacher=teacher,
        )  # fmt: skip
        if teacher != "none":
            settings = replace(settings, updates=300)
        elif not parameters.is_pendulum:
            # There is more to learn: more steps, a lasting spread, and a swing-up is longer than the 2 s that
            # the discount of one joint looks ahead.
            settings = replace(settings, ppo=replace(settings.ppo, least_spread=0.1, discount=0.998), updates=1500)
    return replace(settings, updates=updates) if updates else settings


def _write_curves(out: Path, settings: Training, curves: Any) -> Path:
    from pendulum_bags.figures.figure import Figure, Panel, Trace
    from pendulum_bags.figures.render_files import write_figures

    million, reward, _, spread = curves.T
    million = million / 1e6
    title = f"Training of {settings.task} on {settings.plant.name}, seed {settings.seed}"
    figure = Figure(
        f"{out.stem}_training",
        title,
        f"Mean reward a step over {settings.steps / 1e6:.2g} million steps.",
        [
            Panel("steps [million]", "mean reward a step [-]", [Trace(million, reward, "", "sim")]),
            Panel("steps [million]", "spread of actions [-]", [Trace(million, spread, "", "difference")]),
        ],
        stacked=True,
    )
    return write_figures([figure], out.parent, formats=("png",))[0]


def _sentence(measured: Mapping[str, Any]) -> str:
    if "return_mean" in measured:
        return (
            f"Pendulum-v1: return {measured['return_mean']:.1f} (standard deviation {measured['return_std']:.1f}) over "
            f"{measured['episodes']} episodes"
        )
    time_up = measured["median_time"]
    start = " from hanging at rest" if measured.get("start") == "hanging" else ""
    text = f"{measured['up']} of {measured['trials']} trials{start} end upright"
    text += f", after {time_up:.2f} s in the median" if time_up is not None else ""
    gave_up = measured["gave_up"]
    return f"{text}; {gave_up} left the states that training visited" if gave_up else text


main = command_line(train, "python -m pendulum_learning train")
