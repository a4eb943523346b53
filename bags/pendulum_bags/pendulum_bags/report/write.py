"""Write a report: ``report.html`` and the same figures as PNG and PDF."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.report.data import ReportData, read_trials
from pendulum_bags.report.figures import make_figures
from pendulum_bags.report.joint_page import joint_page
from pendulum_bags.report.page import Page, page_of, render_page
from pendulum_bags.report.tables import make_tables
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.verdict.naming import name_in
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader import read_bag

if TYPE_CHECKING:
    from pendulum_bags.comparison import Comparison
    from pendulum_bags.comparison.margins import MarginArgument
    from pendulum_bags.frequency_response.result import Analysis
    from pendulum_bags.runs.run_data import OpenBag
    from pendulum_bags.verdict import Answer

__all__ = ["margin_of", "title_of", "write_joint_report", "write_report"]


def write_report(
    run_folder: str | os.PathLike[str],
    summary: Mapping[str, Any] | None = None,
    *,
    comparison: Comparison | None = None,
    folders: Sequence[str | os.PathLike[str]] = (),
    trials: Sequence[str | os.PathLike[str]] = (),
    recordings: Sequence[Path] = (),
    formats: Sequence[str] = ("png", "pdf"),
    answer: Answer | None = None,
    certified: Analysis | None = None,
    extend: Callable[[Page], Page] = lambda page: page,
    open_bag: OpenBag = read_bag,
) -> Path:
    """Write ``report.html`` and ``figures/`` into a folder; return the page.

    Args:
        run_folder: Target; also the run folder (``sim``, ``hw``, perhaps ``sim_500hz``) to read unless ``comparison``
            or ``folders`` is given.
        summary: Content of ``summary.json``; by default that of the comparison.
        trials: Folders of the thesis's identification experiments, each with bags ``trial_1``, ``trial_2``, ...
        answer: The sum of all layers; by default of the comparison and of the run folder.
        certified: Designs that carry over; by default from the run folder's response.

    Raises:
        BagError: A bag cannot be read or the folder not be written.
        DataError: A bag lacks what is needed.
    """
    from pendulum_bags.comparison import compare_folders
    from pendulum_bags.frequency_response.carry_over import carry_over, layers_of
    from pendulum_bags.replay.input_replay import replay_recording

    out = Path(run_folder)
    if comparison is None:
        comparison = compare_folders(list(folders) or [out], margin=margin_of(summary), open_bag=open_bag)
    content = {**comparison.to_json(), **(summary or {})}
    replays = [replay_recording(path, "dfki") for path in recordings]
    names = [Path(folder).name for folder in folders] or [out.resolve().name]
    sources = [Path(folder) for folder in folders] if len(folders) == 1 else [] if folders else [out]
    certified = certified or carry_over(comparison, sources)
    answer = answer or answer_of(comparison, sources, updated=layers_of(certified))
    known = [read_trials(path) for path in trials]
    data = ReportData(comparison, content, replays, names, known, answer, certified, open_bag)
    figures, missing = make_figures(data)
    page = page_of(
        data,
        figures,
        make_tables(data),
        missing,
        title=title_of([Path(folder) for folder in folders] or [out], len(comparison.pairs)),
    )
    return _save(out, extend(page), formats)


def write_joint_report(
    out: Path,
    comparisons: Mapping[str, Comparison],
    *,
    folders: Sequence[Path],
    formats: Sequence[str] = ("png", "pdf"),
    answer: Answer,
    extend: Callable[[Page], Page] = lambda page: page,
) -> Path:
    """Write ``report.html`` and ``figures/`` of several joints into ``out``, or raise a BagError; return the page."""
    pairs = len(next(iter(comparisons.values())).pairs)
    return _save(out, extend(joint_page(comparisons, answer, title=title_of(folders, pairs))), formats)


def _save(out: Path, page: Page, formats: Sequence[str]) -> Path:
    """Write the figures, then the page with the figures for print."""
    figures = [name_in(figure, emulated=page.emulated) for figure in page.figures]
    drawn = write_figures(figures, out / "figures", formats)
    text = render_page(page, {path.stem: _for_paper(path) for path in drawn if path.suffix == ".png"})
    target = out / "report.html"
    with writing(f"report {target}", BagError):
        write_atomically(target, text)
    return target


def _for_paper(path: Path) -> bytes:
    """Return a figure with a reduced palette: a quarter of the size."""
    from PIL import Image

    buffer = io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(32, Image.Quantize.MAXCOVERAGE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def title_of(folders: Sequence[Path], runs: int) -> str:
    """Return what a page is about: a run, the two bags of one, or how many runs."""
    if runs > 1:
        return f"{runs} runs"
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        names = [f"{folder.resolve().parent.name}/{name}" for folder, name in zip(folders, names, strict=True)]
    return " and ".join(names)


def margin_of(summary: Mapping[str, Any] | None) -> MarginArgument:
    """Return the margins that a summary was made with, so that page and summary agree."""
    from pendulum_bags.comparison import Margins

    verdict = (summary or {}).get("verdict")
    margins = verdict.get("margins") if isinstance(verdict, Mapping) else None
    if not isinstance(margins, Mapping) or not margins.get("stated"):
        return None
    return Margins.from_dict(margins)
