"""What `ros2 run` and a user of `make` find: a colcon build into an empty folder, and the list of targets."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from pendulum_msgs_py.programs.executables import summary
from pendulum_testing.fixtures import PROJECT

FOLDERS = {
    "pendulum_msgs_py": "pendulum_msgs_py",
    "pendulum_sim": "pendulum_sim",
    "pendulum_lqr": "pendulum_lqr",
    "pendulum_hw_bridge": "pendulum_hw_bridge",
    "pendulum_rosbag": "bags/pendulum_rosbag",
    "pendulum_bags": "bags/pendulum_bags",
    "pendulum_console": "bags/pendulum_console",
    "pendulum_learning": "bags/pendulum_learning",
    "pendulum_course": "bags/pendulum_course",
}


def executables(package: str) -> dict[str, str]:
    table = f"{package}.executables"
    return dict(importlib.import_module(table).EXECUTABLES) if importlib.util.find_spec(table) else {}


PROGRAMS = [(package, program) for package in FOLDERS for program in sorted(executables(package))]


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the packages with colcon into an empty folder; return the install folder."""
    base = tmp_path_factory.mktemp("colcon")
    command = [
        str(Path(sys.executable).with_name("colcon")),
        "--log-base",
        str(base / "log"),
        "build",
        "--base-paths",
        *(str(PROJECT / folder) for folder in FOLDERS.values()),
        "--build-base",
        str(base / "build"),
        "--install-base",
        str(base / "install"),
    ]
    done = subprocess.run(command, cwd=base, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, f"colcon build ended with code {done.returncode}:\n{done.stdout}\n{done.stderr}"
    assert f"{len(FOLDERS)} packages finished" in done.stderr + done.stdout
    return base / "install"


@pytest.mark.parametrize("package", FOLDERS)
def test_a_built_package_is_in_the_ament_index_with_its_manifest(install: Path, package: str) -> None:
    share = install / package / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / package).is_file()
    assert (share / package / "package.xml").read_bytes() == (PROJECT / FOLDERS[package] / "package.xml").read_bytes()
    # Written by the ament build only: colcon's plain Python build, its silent fallback, has no such hook.
    assert "AMENT_PREFIX_PATH" in (share / package / "hook" / "ament_prefix_path.sh").read_text()


@pytest.mark.parametrize("package", FOLDERS)
def test_a_built_package_carries_every_file_that_its_modules_read(install: Path, package: str) -> None:
    source = PROJECT / FOLDERS[package] / package
    (built,) = (install / package / "lib").glob(f"python*/site-packages/{package}")
    of = {
        root: {path.relative_to(root) for path in root.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
        for root in (source, built)
    }
    assert of[source] == of[built]


_LOAD = """
import importlib, sys
from importlib.metadata import distribution
for item in sys.argv[1:]:
    package, _, point = item.partition("=")
    assert point in {found.value for found in distribution(package).entry_points}, item
    module = importlib.import_module(point.partition(":")[0])
    assert callable(getattr(module, point.partition(":")[2])), item
    print(module.__file__)
"""


def test_every_program_stands_where_ros2_run_looks_for_it_and_can_be_loaded_and_one_of_each_package_runs(
    install: Path,
) -> None:
    """What each prints as its help is tested where it is not built: most of that time is the import of libraries."""
    paths = {item: install / item[0] / "lib" / item[0] / item[1] for item in PROGRAMS}
    assert [path for path in paths.values() if not os.access(path, os.X_OK)] == []
    site_packages = [str(path) for path in install.glob("*/lib/python*/site-packages")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(site_packages), "COLUMNS": "100"}

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            list(map(str, command)), capture_output=True, text=True, check=False, timeout=280, env=environment
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    files = run(
        sys.executable, "-c", _LOAD, *(f"{package}={executables(package)[program]}" for package, program in PROGRAMS)
    ).splitlines()
    assert len(files) == len(PROGRAMS)
    assert [file for file in files if not Path(file).is_relative_to(install)] == []
    for path in {package: paths[package, program] for package, program in PROGRAMS}.values():
        assert "usage" in run(path, "--help").lower(), path


def test_a_built_program_runs_the_code_that_was_built(install: Path) -> None:
    (site_packages,) = (install / "pendulum_sim" / "lib").glob("python*/site-packages")
    where = "import pendulum_sim; print(pendulum_sim.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(site_packages)}
    done = subprocess.run(
        [sys.executable, "-c", where],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        cwd=install,
    )
    assert Path(done.stdout.strip()).is_relative_to(install)


@pytest.mark.parametrize("package", sorted({package for package, _ in PROGRAMS}))
def test_python_m_from_the_root_of_the_repository_finds_the_package(package: str) -> None:
    """A folder of the same name stands there; it would shadow a package that only a hook makes importable."""
    done = subprocess.run(
        [sys.executable, "-m", package, "--help"], cwd=PROJECT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert all(program in done.stdout for program in executables(package))


@pytest.mark.parametrize(("package", "program"), PROGRAMS)
def test_every_program_is_an_entry_point_of_the_installed_distribution(package: str, program: str) -> None:
    from importlib.metadata import distribution

    points = {point.name: point.value for point in distribution(package).entry_points}
    # Beside the commands of everybody, `record` or `info` would stand before another's.
    assert points.get("pendulum" if program == "pendulum" else f"pendulum-{program}") == executables(package)[program]
    assert all(name == "pendulum" or name.startswith("pendulum-") for name in points)


def test_the_build_scripts_are_one_and_the_same_file() -> None:
    assert (
        len({(PROJECT / folder / "setup.py").read_bytes() for folder in (*FOLDERS.values(), "tests/pendulum_testing")})
        == 1
    )


@pytest.mark.parametrize("package", FOLDERS)
def test_a_manifest_is_valid_and_names_every_package_of_ros_that_the_code_imports(package: str) -> None:
    from catkin_pkg.package import parse_package

    folder = PROJECT / FOLDERS[package]
    warnings: list[str] = []
    manifest = parse_package(str(folder), warnings=warnings)
    manifest.validate()
    assert not warnings
    assert manifest.get_build_type() == "ament_python"
    assert manifest.licenses == ["Apache-2.0"]
    named = {str(dependency.name) for dependency in manifest.exec_depends}
    ours_or_of_ros = r"rclpy|std_srvs|(?:rcl|builtin)_interfaces|launch(?:_ros)?|\w+_msgs|pendulum_\w+"
    pattern = rf"^\s*(?:from|import) ({ours_or_of_ros})\b"
    imported = {
        match[1]
        for file in (folder / package).rglob("*.py")
        for match in re.finditer(pattern, file.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert imported - named - {package} == set()
    ordered = [element.text for element in ElementTree.parse(folder / "package.xml").iter("exec_depend")]
    assert len(ordered) == len(set(ordered))


def test_make_alone_prints_one_line_for_each_target() -> None:
    # A make that runs these tests hands its flags down; with them make would print the folders it enters.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        ["make"], cwd=PROJECT, capture_output=True, text=True, check=True, timeout=120, env=environment
    )
    lines = done.stdout.splitlines()
    rules = re.findall(r"^\.PHONY: (.+)$", (PROJECT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert [line.split()[1] for line in lines] == rules[0].split()
    assert all(re.fullmatch(r"make [a-z]+ +\S.*", line) for line in lines)


@pytest.mark.parametrize(("package", "program"), PROGRAMS)
def test_the_list_of_programs_says_what_each_is_for(package: str, program: str) -> None:
    text = summary(program, executables(package)[program])
    assert 15 < len(text) < 110, text
    assert "``" not in text
    lines = {summary(name, target) for name, target in executables(package).items()}
    assert len(lines) == len(executables(package))


def test_packages_that_cannot_be_had_are_reported_in_a_sentence_and_tried_again(tmp_path: Path) -> None:
    shutil.copy(PROJECT / "Makefile", tmp_path)
    (tmp_path / "requirements").mkdir()
    for layer in ("run", "extras", "build", "checks", "docs", "test"):
        (tmp_path / "requirements" / f"{layer}.txt").write_text("numpy==1.26.4\n", encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / ".made").touch()
    for _ in range(2):
        # A pip that fails stands for one that has no network: what it says, and that nothing is taken for done.
        made = subprocess.run(
            ["make", "venv", "PIP=false"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
            env=environment,
        )
        assert made.returncode != 0
        assert "installing 1 locked packages" in made.stdout
        assert "could not be installed" in made.stderr
        assert "network" in made.stderr
    assert [path.name for path in (tmp_path / ".venv").iterdir()] == [".made"]
