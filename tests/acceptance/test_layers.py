"""Each target installs what it runs: the layers of the lock agree, and the first suffices for an experiment."""

from __future__ import annotations

import platform
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from pendulum_msgs_py.programs.extras import extra_of, how_to_install
from pendulum_testing.fixtures import PROJECT
from tests import wheel_sizes
from tests.acceptance.test_manifests import imported
from tests.acceptance.test_packaging import FOLDERS, PROGRAMS
from tests.layers import LAYERS, distributions_of_modules, environment_of, pins, requirements

MACHINES = [
    {"python_version": f"3.{minor}", "python_full_version": f"3.{minor}.7", "sys_platform": system}
    for minor in (10, 11, 12, 13, 14)
    for system in ("linux", "darwin", "win32")
]


def installed(layer: str, machine: dict[str, str]) -> dict[str, str]:
    """Return name -> version of what pip takes from a layer on a machine."""
    return {
        canonicalize_name(pin.name): str(pin.specifier)
        for pin in pins(layer)
        if pin.marker is None or pin.marker.evaluate(machine)
    }


@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: " ".join(machine.values()))
def test_all_layers_have_one_version_of_each_package(machine: dict[str, str]) -> None:
    versions: dict[str, set[str]] = {}
    for layer in (*LAYERS, "bench"):
        for name, version in installed(layer, machine).items():
            versions.setdefault(name, set()).add(version)
    # Most of ROS and colcon, a hundred packages, is for Linux alone.
    assert len(versions) > (250 if machine["sys_platform"] == "linux" else 160)
    assert {name: found for name, found in versions.items() if len(found) > 1} == {}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_holds_what_it_is_asked_for_and_nothing_that_the_first_has(layer: str) -> None:
    names, first = (set(installed(each, MACHINES[3])) for each in (layer, "run"))
    assert {canonicalize_name(asked.name) for asked in requirements(layer)} <= names | first
    assert layer == "run" or not names & first


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_and_the_first_hold_all_that_their_packages_need(layer: str) -> None:
    machine = {
        "python_version": "{}.{}".format(*sys.version_info),
        "python_full_version": "{}.{}.{}".format(*sys.version_info),
        "sys_platform": sys.platform,
    }
    there = {**installed("run", machine), **installed(layer, machine)}
    missing = []
    for name in there:
        for entry in map(Requirement, requires(name) or []):
            needed = entry.marker is None or entry.marker.evaluate({"extra": ""})
            if needed and canonicalize_name(entry.name) not in there:
                missing.append(f"{entry.name} of {name}")
    assert missing == []


@pytest.mark.skipif(
    sys.version_info[:2] != (3, 11) or platform.machine() != "x86_64", reason="the page tells of CPython 3.11 on x86_64"
)
def test_the_page_tells_what_each_wheel_brings() -> None:
    told = wheel_sizes.of_page()
    assert len(told) >= 15
    stale = []
    for wheel, (packages, size) in told.items():
        there, weighed = wheel_sizes.as_installed(wheel)
        if packages != there or abs(size - weighed) > max(2.0, 0.02 * weighed):
            stale.append(f"{wheel}: {there} packages, {weighed:.0f} MB")
    assert stale == [], "python -m tests.wheel_sizes prints the rows as they should be"


def test_what_an_experiment_installs_stays_small() -> None:
    assert len(installed("run", MACHINES[3])) <= 110
    heavy = {"casadi", "mujoco", "nicegui", "pandas", "playwright", "pyarrow", "pytest", "statsmodels"}
    assert not heavy & installed("run", MACHINES[3]).keys()


def of_package(package: str) -> dict[str, set[str]]:
    """Return extra -> distributions that a package's wheel names; the extra is empty for what it always needs."""
    found: dict[str, set[str]] = {}
    for entry in map(Requirement, requires(package) or []):
        extra = re.search(r'extra == "([\w-]+)"', str(entry.marker or ""))
        found.setdefault(extra[1] if extra else "", set()).add(canonicalize_name(entry.name))
    return found


@pytest.mark.parametrize("package", FOLDERS)
def test_a_wheel_names_every_library_that_its_modules_import_and_no_other(package: str) -> None:
    # One module may come in several parts, of which a wheel names the one that brings the others.
    of_module = distributions_of_modules()
    used = [{canonicalize_name(name) for name in of_module[module]} for module in imported(package)]
    # The module of `cuda` is numba's, whose part for GPUs it replaces.
    others = {"ros", "rviz", "test", "cuda"}
    named = set().union(*(names for extra, names in of_package(package).items() if extra not in others))
    of_others = {name for name in named if not name.startswith("pendulum-")}
    through_ours = [{"gymnasium"}] if package == "pendulum_learning" else []
    for_its_files = {"plotly"} if package == "pendulum_bags" else set()
    assert [names for names in used if not names & named] == through_ours
    assert of_others - set().union(*used) <= for_its_files


def test_the_first_layer_has_what_the_wheels_always_need_and_the_second_all_their_extras() -> None:
    first, extras, test = ({canonicalize_name(pin.name) for pin in pins(layer)} for layer in ("run", "extras", "test"))
    for package in FOLDERS:
        # What shows plants in a browser is optional as a whole.
        needed = first | extras if package == "pendulum_console" else first
        layers = {"": needed, "emulator": first, "test": first | test}
        for extra, names in of_package(package).items():
            if extra == "cuda":
                # Libraries of some gigabytes, for computers with a GPU.
                continue
            of_others = {name for name in names if not name.startswith("pendulum-")}
            assert of_others <= layers.get(extra, first | extras), (package, extra)


_EVERY_HELP = """
import contextlib, importlib, io, sys
for item in sys.argv[1:]:
    module, function = item.split(":")
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert getattr(importlib.import_module(module), function)(["--help"]) == 0, item
    assert "usage" in said.getvalue().lower(), item
print("all")
"""


_ITS_LIBRARY_FIRST = {"markers", "console"}
"""Programs whose modules are made of what an extra brings: messages of RViz, NiceGUI."""


def test_other_programs_say_their_help_with_the_first_layer_alone(tmp_path: Path) -> None:
    from tests.acceptance.test_packaging import executables

    targets = [executables(package)[program] for package, program in PROGRAMS if program not in _ITS_LIBRARY_FIRST]
    done = subprocess.run(
        [sys.executable, "-c", _EVERY_HELP, *targets],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        env=environment_of(tmp_path / "hide", "run"),
    )
    assert done.stdout.strip() == "all", done.stderr


@pytest.mark.parametrize(
    ("command", "library", "extra"),
    [
        ("pendulum_console console", "uvicorn", "pendulum_console"),
        ("pendulum_console foxglove", "foxglove", "pendulum_console[foxglove]"),
        ("pendulum_sim mujoco --ros-args -p model:=m.xml", "mujoco", "pendulum_sim[mujoco]"),
        (
            "pendulum_bags experiment lockstep --bag b --simulation gymnasium:Pendulum-v1",
            "gymnasium",
            "pendulum_sim[gymnasium]",
        ),
        ("pendulum_bags experiment lockstep --bag b --controller mpc", "osqp", "pendulum_lqr[mpc]"),
        ("pendulum_lqr controller --ros-args -p controller:=nmpc", "casadi", "pendulum_lqr[mpc]"),
        ("pendulum_hw_bridge scan", "hebi", "pendulum_hw_bridge[hebi]"),
    ],
)
def test_a_program_whose_library_is_missing_says_which_extra_brings_it(
    tmp_path: Path, domain_id: int, command: str, library: str, extra: str
) -> None:
    (tmp_path / "m.xml").write_text("<mujoco/>", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", *command.split()],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        cwd=tmp_path,
        env={**environment_of(tmp_path / "hide", "run"), "ROS_DOMAIN_ID": str(domain_id)},
    )
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert f"{library} is not installed" in done.stderr
    assert f"install it with make extras, or python -m pip install '{extra}'" in done.stderr


@pytest.mark.parametrize(
    "command", ["pendulum_lqr design --preset thesis", "pendulum_bags experiment ranking --dry-run"]
)
def test_what_the_readme_and_the_report_of_make_experiment_point_at_runs_with_the_first_layer(
    tmp_path: Path, command: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command.split()],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        cwd=tmp_path,
        env=environment_of(tmp_path / "hide", "run"),
    )
    assert done.returncode == 0, done.stderr


def test_a_library_that_no_package_names_is_no_matter_of_extras() -> None:
    assert extra_of("numpy") == "pendulum_msgs_py"
    assert extra_of("rclpy.node") == "pendulum_msgs_py[ros]"
    assert extra_of("fastapi.responses") == "pendulum_console"
    assert how_to_install(ModuleNotFoundError("No module named 'nobody'", name="nobody")) == ""
    assert how_to_install(ImportError("numpy is broken")) == ""


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("pendulum_hw_bridge.actuator", "pendulum_hw_bridge.actuator is pendulum_hw_bridge.port.actuator now"),
        (
            "pendulum_lqr.policy",
            "pendulum_lqr.policy is pendulum_lqr.controllers.policy or pendulum_lqr.policies.policy now",
        ),
        ("pendulum_lqr.design.design", "pendulum_lqr.design.design is pendulum_lqr.linear.design now"),
        ("pendulum_lqr.nowhere", ""),
    ],
)
def test_a_module_of_ours_that_has_moved_is_answered_with_its_place(module: str, said: str) -> None:
    assert how_to_install(ModuleNotFoundError(f"No module named '{module}'", name=module)) == said


def test_targets_of_make_bring_the_layers_that_they_need() -> None:
    text = (PROJECT / "Makefile").read_text(encoding="utf-8")
    rules = re.findall(r"^([a-z]+):(?!=)(.*)$", text, re.MULTILINE)
    needs = {name: rest.split("#")[0].split() for name, rest in rules}
    assert needs["experiment"] == ["$(VENV)/.linked"]
    assert needs["test"] == ["venv"]
    assert needs["venv"] == ["$(VENV)/.linked", "$(INSTALLED)"]
    assert "$(VENV)/.checks" in needs["lint"]
    assert "$(VENV)/.checks" in needs["types"]
    assert "$(VENV)/.checks" in needs["imports"]
    assert "$(VENV)/.build" in needs["build"]
    assert "$(VENV)/.docs" in needs["docs"]
    assert re.search(rf"^LAYERS := {' '.join(LAYERS)}$", text, re.MULTILINE)
