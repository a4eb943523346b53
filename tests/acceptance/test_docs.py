"""The pages: links lead somewhere, commands that build on each other run in order, the site needs no network."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import pytest
import yaml

from pendulum_console.commands.foxglove_cli import LAYOUT
from pendulum_lqr.controller_interface.controller import CONTROLLERS, Row, make_controller
from pendulum_lqr.linear.design import DesignError
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.acceptance.test_readme import RunLine, run_line

__all__ = ["run_line"]

PAGES = sorted(
    PROJECT / name
    for name in subprocess.run(
        ["git", "ls-files", "*.md"], cwd=PROJECT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
)
_LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
_IN_ORDER = re.compile(r"^<!-- run in order -->\n```console\n(.*?)^```", re.MULTILINE | re.DOTALL)
_ELSEWHERE = re.compile(r"<(?:script|img|link|iframe)\b[^>]*\b(?:src|href)=\"?(https?:|//)[^>]*>")
_TARGET = re.compile(r'(?:href|src)="([^"]*)"')
_TOGETHER = re.compile(
    r"^<!-- start together -->\n```console\n(.*?)^```.*?^<!-- and then -->\n```console\n(.*?)^```",
    re.MULTILINE | re.DOTALL,
)
TOGETHER = [page for page in PAGES if _TOGETHER.search(page.read_text(encoding="utf-8"))]
CHAINS = {
    page: [line.removeprefix("$ ") for block in blocks for line in block.splitlines() if line.startswith("$ ")]
    for page in PAGES
    if (blocks := _IN_ORDER.findall(page.read_text(encoding="utf-8")))
}
JOINTS = next(line for lines in CHAINS.values() for line in lines if " experiment joints " in line)
"""Two sides of several joints; tests/integration/test_experiments.py runs it and looks at what it leaves."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(PROJECT)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [target for target in _LINK.findall(text) if "://" not in target and not target.startswith("mailto:")]
    assert [target for target in targets if not (page.parent / target).exists()] == []


@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", CHAINS, ids=lambda page: str(page.relative_to(PROJECT)))
def test_commands_that_build_on_each_other_run(page: Path, run_line: RunLine, domain_id: int, tmp_path: Path) -> None:
    for line in CHAINS[page]:
        if line != JOINTS:
            run_line(line, tmp_path)


@pytest.mark.parametrize("page", TOGETHER, ids=lambda page: str(page.relative_to(PROJECT)))
def test_programs_that_a_page_starts_together_leave_what_it_looks_at_then(
    page: Path,
    processes: ProcessGroup,
    run_line: RunLine,
    domain_id: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The last of them is a disturbance with a duration; the recorder is ended first."""
    together, then = _TOGETHER.findall(page.read_text(encoding="utf-8"))[0]
    recorders: list[RunningProgram] = []
    others: list[RunningProgram] = []
    monkeypatch.chdir(tmp_path)
    for line in together.splitlines():
        words = shlex.split(line.removeprefix("$ "))
        program = processes.start(words[2], words[3], *words[4:])
        program.wait_for_output(r"\[INFO\].*ready", 200)
        (recorders if words[3] == "record" else others).append(program)
    others[-1].wait_for_output("noise_end", 200)
    for program in [*recorders, *others]:
        program.interrupt()
        assert program.wait(60) == 0, program.output
    for line in then.splitlines():
        run_line(line.removeprefix("$ "), tmp_path)


def _dead_links(page: Path) -> list[str]:
    """Return what a page of the site points at and a browser that opens it from the disk would not find."""
    links = {urlsplit(link) for link in _TARGET.findall(page.read_text(encoding="utf-8"))}
    # The page for what is not found is served by a server alone, whose root its links name.
    local = [it for it in links if not it.scheme and not it.netloc and it.path and page.name != "404.html"]
    return [it.path for it in local if not (page.parent / unquote(it.path)).resolve().is_file()]


@pytest.mark.timeout(600)
def test_the_site_is_built_and_needs_no_other_server() -> None:
    done = subprocess.run(
        ["make", "--no-print-directory", "docs"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    site = PROJECT / "build" / "site"
    pages = list(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        found = _ELSEWHERE.search(page.read_text(encoding="utf-8"))
        # The address of the page itself, for search engines, is no request.
        assert found is None or 'rel="canonical"' in found.group(0), f"{page}: {found and found.group(0)}"
    dead = [f"{page.relative_to(site)}: {link}" for page in pages for link in _dead_links(page)]
    assert dead == []
    text = (site / "pendulum_msgs_py" / "docs" / "reference.html").read_text(encoding="utf-8")
    for word in ("handover_effort_limit", "energy_swing_up", "bringup.launch.py", "pendulum_bags ..."):
        assert word in text


def test_the_reference_has_the_parameters_that_the_programs_read() -> None:
    spec = importlib.util.spec_from_file_location("docs_build", PROJECT / ".docs" / "build.py")
    assert spec is not None
    assert spec.loader is not None
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    assert build.REFERENCE.read_text(encoding="utf-8") == build.reference(), (
        "python .docs/build.py --reference renews it"
    )


def test_layouts_show_signals_that_exist() -> None:
    folder = PROJECT / "bags" / "pendulum_bags" / "config"
    known = set(names.SIGNALS)
    curves = ElementTree.parse(folder / "plotjuggler_layout.xml").getroot().iter("curve")
    plotjuggler = {str(curve.get("name")) for curve in curves}
    assert {name.split("/")[2] for name in plotjuggler} == known
    assert {name.split("/")[1] for name in plotjuggler} == {"sim", "hw"}
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))
    # Panels are named by their type; the layout may show those only that are configured.
    kinds = {name.partition("!")[0] for name in layout["configById"]}
    assert kinds == {"Plot", "3D", "DiagnosticSummary", "CallService", "Parameters"}
    assert set(re.findall(r"\w+![\w]+", json.dumps(layout["layout"]))) <= set(layout["configById"])
    panels = [panel for name, panel in layout["configById"].items() if name.startswith("Plot!")]
    paths = {path["value"].split(".")[0] for panel in panels for path in panel["paths"]}
    assert paths == {f"/{side}/{topic}" for side in ("sim", "hw") for topic in known}
    called = {panel["serviceName"] for name, panel in layout["configById"].items() if name.startswith("CallService!")}
    services = [name.removeprefix("~/") for name in (names.ARM, names.E_STOP, names.E_STOP_RESET)]
    assert called == {f"{plant}/{service}" for plant in ("/sim/simulator", "/hw/bridge") for service in services}


def test_the_controller_manager_gets_our_joint() -> None:
    path = PROJECT / "pendulum_lqr" / "config" / "ros2_control_controllers.yaml"
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert content["effort_controller"]["ros__parameters"]["joints"] == [names.JOINT]


_FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_MARK = re.compile(
    r"not run|run by|run it|run these|run what they do|asks for a module|full jazzy|answers as seen", re.IGNORECASE
)
_HEADING = re.compile(r"^#+ ", re.MULTILINE)


def _blocks(kind: str) -> list[tuple[Path, re.Match[str], str]]:
    """Return the fenced blocks of a kind with their page and the section of the page that they stand in."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        # A comment within a block is no heading.
        plain = _FENCE.sub(lambda block: "~" * len(block.group(0)), text)
        starts = [0, *(it.start() for it in _HEADING.finditer(plain)), len(text)]
        for block in _FENCE.finditer(text):
            first = max(start for start in starts if start <= block.start())
            last = min(start for start in starts if start > block.start())
            if block.group(2) == kind:
                found.append((page, block, text[first:last]))
    return found


def test_commands_that_are_not_run_here_say_so() -> None:
    silent = []
    for page, block, section in _blocks("console"):
        text = page.read_text(encoding="utf-8")
        runs_here = text[: block.start()].endswith(
            ("<!-- run in order -->\n", "<!-- start together -->\n", "<!-- and then -->\n")
        )
        commands = [line for line in block.group(3).splitlines() if line.startswith("$ ")]
        needs_ros = all("ros2 " in line for line in commands)
        if text.find("<!-- the day -->") < block.start() < text.find("<!-- end of the day -->"):
            continue  # a test of its own runs through it
        if not runs_here and not needs_ros and not _MARK.search(section):
            silent.append(f"{page.relative_to(PROJECT)}: {commands[0] if commands else block.group(3)[:60]}")
    assert silent == []


PYTHON = [(page, block.group(3)) for page, block, _ in _blocks("python") if "launch_ros" not in block.group(3)]


@pytest.mark.parametrize(("page", "code"), PYTHON, ids=[str(page.relative_to(PROJECT)) for page, _ in PYTHON])
def test_python_of_a_page_runs_as_it_stands(page: Path, code: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, f"{page}\n{code}\n{done.stderr}"


def test_the_example_of_a_new_controller_runs_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = PROJECT / "pendulum_msgs_py/docs/bring_your_own.md"
    (block,) = re.findall(r"^   ```python\n(.*?)^   ```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (tmp_path / "mine_of_the_page.py").write_text(textwrap.dedent(block), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module("mine_of_the_page")
    monkeypatch.setitem(CONTROLLERS, "mine", Row("mine_of_the_page:Mine"))
    controller = make_controller("mine", load_plant("thesis"), period=0.01, values={"kp": 20.0})
    assert controller.command(0.0, (0.1, 0.0)) == pytest.approx(-2.0)
    with pytest.raises(DesignError, match="mine makes the loop unstable"):
        make_controller("mine", load_plant("thesis"), period=0.01, values={"kp": -1.0})
