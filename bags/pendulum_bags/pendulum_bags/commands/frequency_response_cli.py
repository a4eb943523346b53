"""``frequency_response``: measure plants from recordings, compare them and certify designs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from pendulum_bags.commands.recording_options import (
    Dt,
    Mappings,
    Start,
    Stop,
    Topics,
    WriteMapping,
    readings_of,
    show_guesses,
)
from pendulum_bags.experiments.plant_options import (
    AcceptDifferences,
    MappingFile,
    SimulatedPlant,
    Simulation,
    Strategy,
)
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import command_line, typed_options
from pendulum_msgs_py.programs.options import Domain, Json, Storage, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_bags.frequency_response.result import Analysis

__all__ = ["experiment", "main"]


Design = Annotated[
    list[str] | None,
    typer.Option(
        help="Design to certify: 'q=100,0.01 r=0.1', 'k=33,0.2', a controller's name or a policy file (.npz); may be "
        "given again. Default: the policy that ran, or the four combinations of the thesis."
    ),
]
Angle = Annotated[float, typer.Option(help="Angle that the task allows, one unit of the gap [rad].")]
Velocity = Annotated[float, typer.Option(help="Velocity that the task allows [rad/s].")]
Torque = Annotated[float, typer.Option(help="Torque that the task has for it [N m].")]
GapMargin = Annotated[
    float, typer.Option(help="Gap between the plants that does not matter, 0 to 1.", min=0.0, max=1.0)
]


def frequency_response(
    context: typer.Context,
    bags: Annotated[
        list[Path],
        typer.Argument(help="A recording of any format, those of simulation and hardware, or a run folder with both."),
    ],
    out: Annotated[
        Path | None,
        out_option("Folder for page, figures and measured responses; none by default."),
    ] = None,
    plant: Annotated[str, typer.Option(help="Plant of the designs: preset or file; default: that of the bag.")] = "",
    design: Design = None,
    angle: Angle = 0.03,
    velocity: Velocity = 3.0,
    torque: Torque = 1.0,
    gap_margin: GapMargin = 0.2,
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    start: Start = None,
    stop: Stop = None,
    json_output: Json = False,
) -> None:
    """Measure a plant's frequency response under feedback, and say which designs are safe to carry over to it.

    Any recording with a known, rich disturbance or reference serves; a multisine is the most informative. Example:

        python -m pendulum_bags frequency_response bags/runs/today --design "q=100,0.01 r=0.1" --design pid
    """
    from pendulum_bags.frequency_response.analyse import analyse_responses, read_responses
    from pendulum_lqr.responses.gap_metric import Scaling
    from pendulum_msgs_py.plants.plant_parameters import is_mechanism, load_mechanism

    scaling = Scaling(angle, velocity, torque)
    readings = readings_of(bags, mapping, topic, dt, start, stop)
    console = make_console(stderr=json_output, highlight=False)
    context.call_on_close(partial(show_guesses, console, readings, write_mapping))
    joints = load_mechanism(plant).coordinates.names if plant and is_mechanism(plant) else ()
    responses, recorded, ran = read_responses(readings, joints)
    if not plant and any(reading.was_mapped for reading in readings):
        named = next(reading for reading in readings if reading.was_mapped)
        raise ParameterError(f"{named} does not name its plant; expected --plant, on which designs are made")
    several = bool(responses[0].joints)
    if several and (typed := typed_options(context, {"angle", "velocity", "torque"})):
        raise ParameterError(f"{typed[0]} is for plants of one joint; of several the LQR weights are the units")
    analysis = analyse_responses(
        responses,
        plant or recorded,
        design or ran,
        scaling=None if several else scaling,
        margin=None if several and not typed_options(context, {"gap_margin"}) else gap_margin,
        recorded=not design,
    )
    _tell(console, analysis, out, json_output=json_output)


def experiment(
    out: Annotated[
        Path | None,
        out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_frequency_response."),
    ] = None,
    plant: SimulatedPlant = None,
    simulation: Simulation = "",
    mapping: MappingFile = None,
    accept_differences: AcceptDifferences = False,
    strategy: Strategy = "direct_pwm",
    controller: Annotated[
        str, typer.Option(help="Controller that holds both plants meanwhile, or a policy file (.npz).")
    ] = "lqr",
    realtime: Annotated[bool, typer.Option(help="Keep the wall's time, instead of lockstep.")] = False,
    amplitude: Annotated[float, typer.Option(help="Largest torque of the multisine [N m].")] = 2.5,
    signal_period: Annotated[float, typer.Option(help="Length of one period of it [s].")] = 4.0,
    periods: Annotated[int, typer.Option(help="Periods that are averaged; one more settles.", min=3, max=1000)] = 8,
    lowest: Annotated[float, typer.Option(help="Lowest frequency [Hz].")] = 0.25,
    highest: Annotated[float, typer.Option(help="Highest frequency [Hz]; the slower plant's rate is 100.")] = 47.5,
    lines: Annotated[int, typer.Option(help="Number of frequencies, at most.", min=5, max=1000)] = 48,
    seed: Annotated[int, typer.Option(help="Seed of the phases.", min=0)] = 1,
    design: Design = None,
    angle: Angle = 0.03,
    velocity: Velocity = 3.0,
    torque: Torque = 1.0,
    gap_margin: GapMargin = 0.2,
    storage: Storage = "mcap",
    domain: Domain = None,
    json_output: Json = False,
) -> None:
    """Excite simulator and emulated hardware by one multisine, measure both plants, and certify designs.

    For a real actuator, record any experiment with a rich disturbance and hand its bag to frequency_response.

    Example: python -m pendulum_bags experiment frequency_response --design "q=100,0.01 r=0.1" --design pid
    """
    from pendulum_bags.experiments.domain import check_domain
    from pendulum_bags.experiments.host_pool import open_pool
    from pendulum_bags.experiments.lockstep import record_run
    from pendulum_bags.experiments.new_run import new_run
    from pendulum_bags.experiments.progress import PhaseProgress
    from pendulum_bags.experiments.repeats import record_simulation
    from pendulum_bags.experiments.run_spec import SIDES, RunSpec
    from pendulum_bags.frequency_response.analyse import analyse_responses, read_responses
    from pendulum_bags.frequency_response.multisine import Multisine
    from pendulum_lqr.policies.policy_file import named_controller
    from pendulum_lqr.responses.controller_response import require_time_invariant
    from pendulum_lqr.responses.gap_metric import Scaling
    from pendulum_msgs_py.plants.plant_parameters import require_one_joint

    if plant is not None:
        require_one_joint(plant, f"python -m pendulum_bags experiment joints --plant {plant}, which measures it, too")
    scaling = Scaling(angle, velocity, torque)
    kind, parameters = named_controller(controller)
    require_time_invariant(kind)
    check_domain(domain)
    console = make_console(stderr=json_output, highlight=False)
    sim, hw = (
        RunSpec(
            side=side,
            plant=(plant or "thesis") if side == "sim" else "thesis",
            design_plant=plant or "thesis",
            simulation=simulation if side == "sim" else "",
            mapping=str(mapping or "") if side == "sim" else "",
            strategy=strategy,
            controller=kind,
            controller_parameters=parameters,
            seed=seed,
            storage=storage,
            clock="realtime" if realtime else "lockstep",
        )
        for side in SIDES
    )
    specs: Sequence[RunSpec] = Multisine(amplitude, signal_period, periods, lowest, highest, lines).specs(sim, hw)
    if (foreign := sim.foreign) is not None and plant is None and not accept_differences:
        foreign.require_equation()
    started = time.monotonic()
    starting, shares = ((6.0, 6.0), (1.0, 1.0)) if realtime else ((0.0, 6.0), (0.05, 0.15))
    expected = [start + share * spec.duration for spec, start, share in zip(specs, starting, shares, strict=True)]
    with (
        new_run(out, "frequency_response", console) as folder,
        open_pool() as hosts,
        PhaseProgress(sum(expected) + 12.0, console) as progress,
    ):
        if foreign is not None and plant is None:
            equation = str(foreign.write_equation(folder))
            specs = tuple(replace(spec, design_plant=equation) for spec in specs)
        for spec, length in zip(specs, expected, strict=True):
            progress.phase("simulation" if spec.side == "sim" else "hardware", length)
            if spec.has_bridge or realtime:
                record_run(folder / spec.side, spec, domain=domain, hosts=hosts)
            else:
                record_simulation(folder / spec.side, spec)
        progress.phase("analysing", 12.0)
        responses, recorded, ran = read_responses([folder])
        analysis = analyse_responses(responses, recorded, design or ran, scaling=scaling, margin=gap_margin)
    _tell(console, analysis, folder, json_output=json_output)
    console.print(f"bags    {folder / 'sim'}, {folder / 'hw'}\n({time.monotonic() - started:.0f} s)", soft_wrap=True)


def _tell(console: Console, analysis: Analysis, out: Path | None, *, json_output: bool) -> None:
    from pendulum_bags.frequency_response.designs import designs_table
    from pendulum_bags.frequency_response.write import write_analysis

    page = None
    if out is not None:
        if out.exists() and not out.is_dir():
            raise DataError(f"--out is {out}, a file; expected a folder")
        page = write_analysis(out, analysis)
    if json_output:
        print(json_text(analysis.to_json()))
        return
    for response in analysis.responses:
        facts = response.facts
        console.print(
            f"{response.label}: {response.frequency.size} frequencies from {response.frequency[0]:.3g} to "
            f"{response.frequency[-1]:.3g} Hz, {facts['blocks']} {facts['method']} of {facts['block_length_s']:g} s, "
            + _extent(facts),
            soft_wrap=True,
        )
    for layer in analysis.layers:
        console.print(f"\n{layer.layer.title}: {layer.mark.value}", style="bold")
        console.print(layer.sentence)
    if analysis.designs:
        console.print(designs_table(analysis.designs))
    if page is not None:
        console.print(f"\npage    {page}\nagain   {out}/hw_response.json for design --machine", soft_wrap=True)


def _extent(facts: Mapping[str, Any]) -> str:
    if "largest_deviation" in facts:
        deviations = ", ".join(f"{joint} {value:.3g}" for joint, value in facts["largest_deviation"].items())
        return f"largest deviations {deviations} rad or m, largest effort {facts['largest_effort']:.3g} N m or N"
    return f"largest angle {facts['largest_angle_rad']:.3f} rad, largest torque {facts['largest_torque_nm']:.2f} N m"


main = command_line(frequency_response, "python -m pendulum_bags frequency_response")
