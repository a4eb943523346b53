"""``report``: write a page with verdict, figures and provenance, from one run folder or several."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_bags.commands.compare_cli import DesignOption, LayersOption, MachineOption
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
from pendulum_msgs_py.errors import BagError, DataError
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_rosbag.reader.open_source import is_bag_folder, is_storage_file

if TYPE_CHECKING:
    from pendulum_bags.recordings.reading import Reading
    from pendulum_bags.report.page import Page

__all__ = ["main"]


def report(
    context: typer.Context,
    folders: Annotated[
        list[Path],
        typer.Argument(
            help="Run folders (each with sim and hw), or recordings of simulation and hardware in any format "
            "(several of a run that was repeated); folders of trials join in."
        ),
    ],
    out: Annotated[
        Path | None,
        out_option("Folder of the report; by default the run folder itself."),
    ] = None,
    margin: Annotated[
        list[str] | None,
        typer.Option("--margin", help="As for compare: NAME=VALUE, several times if wanted."),
    ] = None,
    margins_file: Annotated[Path | None, typer.Option("--margins", help="File of margins, as for compare.")] = None,
    layers: LayersOption = None,
    machine: MachineOption = None,
    design: DesignOption = None,
    recording: Annotated[
        list[Path] | None,
        typer.Option(help="Recording of a real pendulum to replay in the report (CSV or bag)."),
    ] = None,
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    start: Start = None,
    stop: Stop = None,
    png_only: Annotated[bool, typer.Option("--png-only", help="Leave out the PDF figures.")] = False,
) -> None:
    """Write report.html and figures/ for one run, or for several runs pooled; joint by joint where there are several.

    Example: python -m pendulum_bags report bags/runs/2026-01-31T12-00-00Z_thesis
    """
    from pendulum_bags.comparison import Margins, compare_folders, compare_runs
    from pendulum_bags.figures.table import Table
    from pendulum_bags.frequency_response.carry_over import carry_over, layers_of
    from pendulum_bags.recordings.reading import GUESS_HEAD, guess_rows
    from pendulum_bags.report import write_report
    from pendulum_bags.report.write import margin_of, write_joint_report
    from pendulum_bags.runs.cached_bags import CachedBags
    from pendulum_bags.runs.run_data import joints_of, shared_joints
    from pendulum_bags.verdict.answer import answer_of

    started = time.monotonic()
    trials = [folder for folder in folders if (folder / "trial_1").exists()]
    folders = [folder for folder in folders if folder not in trials]
    if trials and not folders:
        raise BagError(
            f"{trials[0]} holds trials and no run; expected a run folder next to it (identify --page shows trials)"
        )
    margins = Margins.of(margins_file, margin)
    if not margins.stated and len(folders) == 1:
        margins = Margins.of_run(folders[0]) or margins
    readings: list[Reading] = []
    if pooled := all((folder / "sim").exists() and (folder / "hw").exists() for folder in folders):
        run = partial(compare_folders, folders)
    elif len(folders) > 1 and not any((folder / "sim").exists() for folder in folders):
        readings = readings_of(folders, mapping, topic, dt, start, stop)
        context.call_on_close(partial(show_guesses, make_console(stderr=True), readings, write_mapping))
        run = partial(compare_runs, *readings)
    else:
        bad = next(folder for folder in folders if not ((folder / "sim").exists() and (folder / "hw").exists()))
        if not bad.exists():
            raise BagError(f"run folder {bad} does not exist")
        if is_storage_file(bad) or (bad.is_dir() and is_bag_folder(bad)):
            raise BagError(
                f"{bad} is one bag; expected run folders, or two bags to compare (`pendulum info {bad}` shows what is "
                "in it)"
            )
        raise BagError(f"run folder {bad} has no bags sim and hw; expected run folders, or two bags")
    alone = folders[0] if pooled and len(folders) == 1 else None
    target = out or alone or folders[0].resolve().parent / "report"
    sources = [*([alone] if alone else ()), *(layers or ())]
    formats = ("png",) if png_only else ("png", "pdf")

    def extend(page: Page) -> Page:
        rows = guess_rows([reading for reading in readings if reading.was_mapped])
        shown = [(*cells[:-1], f"{cells[-1]} (assumed)" if assumed else cells[-1]) for cells, assumed in rows]
        sentence = "Names proposed it, the data tested it; what no test shows is marked as assumed."
        guessed = [Table("What was guessed", sentence, GUESS_HEAD, shown, "Provenance")] if rows else []
        return replace(page, provenance=[*guessed, *page.provenance])

    with CachedBags() as bags:
        names = shared_joints(readings, open_bag=bags) if readings else {}
        if joints := tuple(names) if readings else joints_of(folders[0] / "sim", open_bag=bags):
            if trials or machine or design or recording:
                raise DataError(
                    "folders of trials, --machine, --design and --recording are of plants of one joint; expected none "
                    f"of them for a plant of {len(joints)} ({', '.join(joints)})"
                )
            if alone and not margins.stated:
                margins = Margins.parse(margin_of(_of_joint(alone, joints[0])))
            run = partial(run, joints=names) if readings else run
            comparisons = {joint: run(margin=margins, joint=joint, open_bag=bags) for joint in joints}
            answer = answer_of(comparisons, sources)
            page = write_joint_report(
                target, comparisons, folders=folders, formats=formats, answer=answer, extend=extend
            )
        else:
            summary = _summary(alone) if alone and not margins.stated else None
            if summary is not None:
                margins = Margins.parse(margin_of(summary))
            result = run(margin=margins, open_bag=bags)
            certified = carry_over(result, sources, machine, design or ())
            answer = answer_of(result, sources, updated=layers_of(certified))
            page = write_report(
                target,
                {key: value for key, value in (summary or {}).items() if key != "verdict"},
                comparison=result,
                folders=folders if len(folders) > 1 else (),
                trials=trials,
                recordings=recording or (),
                formats=formats,
                answer=answer,
                certified=certified,
                extend=extend,
                open_bag=bags,
            )
    print(answer.sentence)
    print(f"report  {page} ({page.stat().st_size / 1e6:.1f} MB, {time.monotonic() - started:.1f} s)")
    print(f"figures {page.parent / 'figures'}")


def _of_joint(folder: Path, joint: str) -> dict[str, object] | None:
    """Return the run's own comparison of a joint; empty if damaged or missing."""
    try:
        content = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        found = content["joints"][joint]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return found if isinstance(found, dict) else None


def _summary(folder: Path) -> dict[str, object] | None:
    """Return the run's own summary with its settings; a damaged one is ignored."""
    try:
        content = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    shown = ("experiment", "seed", "strategy", "versions", "git_revision", "verdict")
    return {key: content[key] for key in shown if key in content} if isinstance(content, dict) else None


main = command_line(report, "python -m pendulum_bags report")
