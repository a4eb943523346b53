"""``experiment joints``: a plant of several joints, held upright under noise, beside what stands in for its machine."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.commands.compare_cli import MarginOption, MarginsFile
from pendulum_bags.experiments.new_run import new_run
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_msgs_py.errors import DataError, FaultError, ParameterError
from pendulum_msgs_py.programs.options import Json, Storage, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["joints"]

_STARTING, _PACE = 6.0, 0.4
"""Wall time in which the nodes of a side start [s], and of simulated time, on two cores."""
_ANALYSING = 8.0
"""Wall time to analyse and draw frequency responses [s]."""
Design = Annotated[
    list[str] | None,
    typer.Option(
        help="Design to certify for the machine: 'q=10,100,1,1 r=0.1', positions before velocities, or 'k=...'; may be "
        "given again. Default: the plant's own LQR, and three with another cost of the effort."
    ),
]


def joints(
    out: Annotated[
        Path | None,
        out_option("Folder of the run; it must be new. Default: bags/runs/<UTC>_joints."),
    ] = None,
    plant: Annotated[
        str, typer.Option(help="Preset or plant file of several joints: simulated, and designed on.")
    ] = "cart_pole",
    machine: Annotated[
        Path | None,
        typer.Option(help="Plant file that stands in for the machine; by default drawn by --share and --delay."),
    ] = None,
    share: Annotated[
        float, typer.Option(help="Largest share by which its masses, lengths, inertias and friction are off.")
    ] = 0.05,
    delay: Annotated[float, typer.Option(help="Transport delay of its motors [s].")] = 0.004,
    joint: Annotated[str, typer.Option(help="Driven joint that has the noise; by default the first.")] = "",
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
            "and of a track. Frequencies and ranking are those of LQRs."
        ),
    ] = "lqr",
    seed: Annotated[int, typer.Option(help="Seed of the noise, and of the draw.", min=0)] = 1,
    frequencies: Annotated[
        bool,
        typer.Option(
            help="Measure both plants at many frequencies too, and certify designs: two more layers of the answer, "
            "where one joint is driven."
        ),
    ] = True,
    periods: Annotated[
        int, typer.Option(help="Periods that are averaged for it; one more settles.", min=3, max=1000)
    ] = 8,
    signal_period: Annotated[
        float, typer.Option(help="Length of one period [s]; its inverse is the lowest frequency.", min=0.5, max=100.0)
    ] = 4.0,
    design: Design = None,
    rank_seeds: Annotated[
        int,
        typer.Option(
            help="Seeds of the noise under which every design (LQR, at least three) runs on both sides, for the layer "
            "“same choice”; 0 leaves it out, 1 gives no interval.",
            min=0,
            max=100,
        ),
    ] = 0,
    storage: Storage = "mcap",
    margin: MarginOption = None,
    margins_file: MarginsFile = None,
    json_output: Json = False,
) -> None:
    """Hold a plant of several joints upright under noise, and another one in the place of its machine; compare both.

    In the place of the machine the bridge drives an emulated one: quasi-direct drives, encoders and delays on a plant
    that is a little off. The answer calls it emulated hardware.
    Both sides run as nodes over DDS, in lockstep, under one controller that is designed on the simulated plant, where
    the dry friction of a passive joint counts as viscous: else acrobot and pendubot would fall. Then a multisine
    measures both plants, and says which designs carry over.

    Example: python -m pendulum_bags experiment joints --plant acrobot --share 0.1
    """
    from pendulum_bags.commands.compare_cli import compare
    from pendulum_bags.experiments.host_pool import open_pool
    from pendulum_bags.experiments.joint_run import (
        JointSettings,
        design_for,
        load_stand_in,
        record_joints,
        stand_in_for,
    )
    from pendulum_bags.frequency_response.designs import designs_table, read_designs
    from pendulum_bags.frequency_response.joint_experiment import FOLDER, JointMultisine, measure_joints
    from pendulum_bags.ranking.joint_choice import COST, DURATION, rank_joints, rankable
    from pendulum_bags.ranking.joint_choice import FOLDER as RANKING
    from pendulum_bags.ranking.present import Words, same_choice, write_ranking
    from pendulum_bags.runs.case import Case, plant_identity
    from pendulum_bags.runs.next_test import MACHINE_FILE
    from pendulum_bags.verdict import write_layer
    from pendulum_lqr.linear.model import linearise
    from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism, write_mechanism

    settings = JointSettings(plant, joint, amplitude, hold_time, duration, seed, storage=storage, controller=controller)
    simulated = load_mechanism(plant)
    drawn = (
        load_stand_in(machine, simulated) if machine else stand_in_for(simulated, share=share, delay=delay, seed=seed)
    )
    measured = frequencies and len(simulated.coordinates.driven) == 1
    if design and not measured:
        raise ParameterError(
            "--design needs both plants measured; expected --frequencies, and a plant with one driven joint: "
            f"{simulated.name} has {len(simulated.coordinates.driven)}"
        )
    on = design_for(simulated)
    # Before anything runs: a slip of the pen should not cost a minute.
    designs = read_designs(design or (), on, linearise(on)) if design or rank_seeds else ()
    ranked = rankable(designs) if rank_seeds else ()
    console = make_console(stderr=json_output, highlight=False)
    started = time.monotonic()
    with new_run(out, "joints", console) as folder:
        made = write_mechanism(folder / MACHINE_FILE, drawn, provenance={"stands_in_for": f"the machine of {plant}"})
        expected = _STARTING + _PACE * duration
        multisine = JointMultisine(settings, periods, signal_period)
        longer = _STARTING + _PACE * multisine.run.duration if measured else 0.0
        analysis = None
        each = _STARTING + _PACE * min(duration, DURATION)
        runs = 2.0 * rank_seeds * len(ranked)
        # Four programs a run: started once for all runs.
        with (
            open_pool() as hosts,
            PhaseProgress(2.0 * (expected + longer) + _ANALYSING * measured + each * runs, console) as progress,
        ):
            record_joints(
                folder,
                settings,
                made,
                hosts=hosts,
                on_side=lambda side: progress.phase(side, expected),
            )
            if measured:
                try:
                    analysis = measure_joints(
                        folder,
                        multisine,
                        made,
                        design or (),
                        hosts=hosts,
                        on_side=lambda side: progress.phase(f"{side}, multisine", longer),
                        on_analysis=lambda what: progress.phase(what, 0.5 * _ANALYSING),
                    )
                except (FaultError, DataError) as error:
                    # The comparison under noise stays valid.
                    console.print(f"The frequencies were not measured: {error}", style="yellow", soft_wrap=True)
            if rank_seeds:
                found = rank_joints(
                    folder / RANKING,
                    settings,
                    made,
                    ranked,
                    range(seed, seed + rank_seeds),
                    hosts=hosts,
                    on_run=lambda what: progress.phase(what, each),
                )
                words = Words("--rank-seeds 10", f"experiment joints --plant {plant} --periods 40", COST)
                case = Case(*map(plant_identity, (simulated, drawn)))
                write_ranking(folder / RANKING, found, words=words, emulated=True, case=case)
                write_layer(folder, same_choice(found, words, case))
    if analysis is not None and not json_output:
        console.print(designs_table(analysis.designs))
    compare([folder], margin=margin, margins_file=margins_file, out=folder, json_output=json_output)
    console.print(
        f"The emulated hardware is the bridge on an emulated machine of {made}"
        + ("." if machine else f": values of {plant} off by up to {100.0 * share:g} %, {1e3 * delay:g} ms of delay."),
        soft_wrap=True,
    )
    if analysis is not None:
        console.print(f"page    {folder / FOLDER / 'frequency_response.html'}", soft_wrap=True)
    if rank_seeds:
        console.print(f"page    {folder / RANKING / 'ranking.html'}", soft_wrap=True)
    console.print(f"bags    {folder / 'sim'}, {folder / 'hw'}\n({time.monotonic() - started:.0f} s)", soft_wrap=True)
