"""Each package runs its own tests from its own folder, by itself, and `colcon test` counts them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS

SHARED = PROJECT / "tests" / "pendulum_testing"


def _alone(package: str, into: Path) -> Path:
    """Copy a package as it is committed, or would be, into an empty folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z", FOLDERS[package]],
        cwd=PROJECT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        target = into / package / Path(name).relative_to(FOLDERS[package])
        target.parent.mkdir(parents=True, exist_ok=True)
        if (PROJECT / name).is_file():
            shutil.copyfile(PROJECT / name, target)
    return into / package


def _run(*command: str | Path, cwd: Path, timeout: float = 280.0) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    # Where no environment has linked it, it is found as an installed one would be, its fixtures included.
    environment |= {"PYTHONPATH": str(SHARED), "PYTEST_PLUGINS": "pendulum_testing.fixtures"}
    return subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, check=False, timeout=timeout, env=environment
    )


_COLLECT = """
import contextlib, importlib, os, sys
import pytest

for name in sys.argv[1].split():
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
for folder in sys.argv[2:]:
    if (child := os.fork()) == 0:
        os.chdir(folder)
        sys.path[0] = folder
        with open(folder + ".txt", "w") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            # To rewrite the assertions of what is only collected takes longer than all the rest.
            code = pytest.main(["--collect-only", "-q", "--assert=plain", "-p", "no:cacheprovider"])
            sys.stdout.flush()
        os._exit(code)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(open(folder + ".txt").read()[-3000:])
"""
"""Collects the tests of each folder in a process of its own; the libraries of others, half of the time, load once."""
_LIBRARIES = (
    "numpy scipy.optimize scipy.signal scipy.stats scipy.integrate hypothesis matplotlib.pyplot rclpy.node numba"
)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Collect the tests of each package where it lies alone; return the folder of all, and of what each printed."""
    base = tmp_path_factory.mktemp("alone")
    folders = [_alone(package, base / package) for package in FOLDERS]
    done = _run(sys.executable, "-c", _COLLECT, _LIBRARIES, *folders, cwd=base)
    assert done.returncode == 0, done.stdout + done.stderr
    return base


@pytest.mark.parametrize("package", FOLDERS)
def test_a_package_that_lies_alone_collects_all_of_its_tests(package: str, collected: Path) -> None:
    folder = collected / package / package
    lines = folder.with_suffix(".txt").read_text(encoding="utf-8").splitlines()
    found = {line.partition("::")[0] for line in lines if "::" in line}
    assert found == {f"test/{file.name}" for file in (folder / "test").glob("test_*.py")}


@pytest.mark.parametrize("package", [*FOLDERS, "pendulum_testing"])
def test_a_package_has_its_changelog_and_tests_that_depend_on_what_they_import(package: str) -> None:
    folder = PROJECT / FOLDERS.get(package, "tests/pendulum_testing")
    lines = (folder / "CHANGELOG.rst").read_text(encoding="utf-8").split("\n")
    assert (lines[1], lines[4]) == (f"Changelog for package {package}", "Forthcoming")
    manifest = ElementTree.parse(folder / "package.xml")
    named = {str(element.text) for kind in ("exec_depend", "test_depend") for element in manifest.iter(kind)}
    imported = {
        name
        for file in (folder / "test").glob("*.py")
        for name in re.findall(r"^(?:from|import) (pendulum_\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    }
    # pendulum_testing depends on pendulum_msgs_py: the way back would close a circle.
    assert imported - named - {package} == ({"pendulum_testing"} if package == "pendulum_msgs_py" else set())


def test_colcon_test_runs_the_tests_of_a_package_and_one_that_fails_makes_it_red(tmp_path: Path) -> None:
    folder = _alone("pendulum_msgs_py", tmp_path / "src")
    for file in (folder / "test").glob("test_*.py"):
        if file.name != "test_angle_wrapping.py":
            file.unlink()
    colcon = Path(sys.executable).with_name("colcon")
    arguments = ("--base-paths", folder)
    built = _run(colcon, "build", *arguments, cwd=tmp_path)
    assert built.returncode == 0, built.stderr
    results = []
    for broken in (False, True):
        if broken:
            (folder / "test" / "test_broken.py").write_text("def test_broken():\n    assert False\n", encoding="utf-8")
        done = _run(colcon, "test", *arguments, "--return-code-on-test-failure", cwd=tmp_path)
        suite = ElementTree.parse(tmp_path / "build" / "pendulum_msgs_py" / "pytest.xml").find("testsuite")
        assert suite is not None
        results.append((done.returncode == 0, int(suite.get("tests", 0)), int(suite.get("failures", 0))))
    (green, count, _), red = results
    assert green
    assert count > 0
    assert red == (False, count + 1, 1)


@pytest.mark.parametrize("package", [name for name in FOLDERS if name != "pendulum_msgs_py"])
def test_colcon_finds_the_tests_of_every_package_by_the_same_extra(package: str) -> None:
    extra = (PROJECT / FOLDERS[package] / "setup.cfg").read_text(encoding="utf-8").partition("\ntest =\n")[2]
    assert extra.splitlines()[:4] == ["    hypothesis", "    pendulum_testing", "    pytest", "    pytest-timeout"]
