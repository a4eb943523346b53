"""Wheels and source archives of the packages: built without a network, installed into an empty folder, run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest

from pendulum_msgs_py.loops.compile_loop import COMMON
from pendulum_msgs_py.loops.machine_code import keep_loop
from pendulum_rosbag.reader import read_bag
from pendulum_testing.fixtures import PROJECT
from tests.layers import environment_of

FOLDERS = (
    "pendulum_msgs_py",
    "pendulum_sim",
    "pendulum_lqr",
    "pendulum_hw_bridge",
    "bags/pendulum_rosbag",
    "bags/pendulum_bags",
    "bags/pendulum_console",
    "bags/pendulum_learning",
    "bags/pendulum_course",
)


def _run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**os.environ, **(env or {})},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _copy_of(folder: str, to: Path) -> Path:
    """Copy what git knows, as a clean clone has it: a build leaves its traces in its folder."""
    known = ["git", "ls-files", "--cached", "--others", "--exclude-standard", folder]
    listed = subprocess.run(known, cwd=PROJECT, capture_output=True, text=True, check=True).stdout
    for name in listed.splitlines():
        if (PROJECT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(PROJECT / name, to / name)
    return to / folder


_BUILD = """
import os, sys, tarfile

from setuptools import build_meta

archives, unpacked, wheels, *folders = sys.argv[1:]
for folder in folders:
    if (child := os.fork()) == 0:
        os.chdir(folder)
        archive = build_meta.build_sdist(archives)
        with tarfile.open(os.path.join(archives, archive)) as content:
            # CPython knows filters from 3.10.12 and 3.11.4 on.
            content.extraction_filter = getattr(tarfile, "data_filter", None)
            content.extractall(unpacked)
        os.chdir(os.path.join(unpacked, archive.removesuffix(".tar.gz")))
        assert not build_meta.get_requires_for_build_wheel()
        os.mkdir("metadata")
        metadata = os.path.abspath("metadata")
        name = build_meta.prepare_metadata_for_build_wheel(metadata)
        build_meta.build_wheel(wheels, metadata_directory=os.path.join(metadata, name))
        raise SystemExit(0)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"{folder} is not built")
"""
"""What pip asks of the build system, in a process for each package; its modules, most of the time, are loaded once."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build each package's source archive, and its wheel from that; return the folder of the wheels."""
    base = tmp_path_factory.mktemp("distributions")
    folders = [base / name for name in ("archives", "unpacked", "wheels")]
    for folder in folders:
        folder.mkdir()
    sources = [_copy_of(name, base / "source") for name in FOLDERS]
    # Alone with what the packages ask for, as pip builds them; among hundreds of others it takes twice as long.
    (alone := base / "alone").mkdir()
    installed = Path(str(distribution("setuptools").locate_file("")))
    for path in (path for name in ("setuptools*", "_distutils_hack") for path in installed.glob(name)):
        (alone / path.name).symlink_to(path)
    _run(sys.executable, "-S", "-c", _BUILD, *folders, *sources, cwd=base, env={"PYTHONPATH": str(alone)})
    return base / "wheels"


@pytest.mark.timeout(900)
def test_the_packages_are_wheels_with_launch_files_and_layouts(wheels: Path) -> None:
    assert len(list(wheels.glob("*.whl"))) == len(FOLDERS)
    held = {name for wheel in wheels.glob("*.whl") for name in zipfile.ZipFile(wheel).namelist()}
    for ending in (
        "share/pendulum_lqr/launch/bringup.launch.py",
        "share/pendulum_sim/rviz/pendulum.rviz",
        "share/pendulum_bags/config/plotjuggler_layout.xml",
        "pendulum_console/live/foxglove_layout.json",
        "pendulum_console/console/static/console.js",
        "pendulum_msgs_py/plants/presets/thesis.yaml",
    ):
        assert any(name.endswith(ending) for name in held), ending
    archives = list((wheels.parent / "archives").glob("*.tar.gz"))
    assert len(archives) == len(FOLDERS)
    for archive in archives:
        with tarfile.open(archive) as content:
            assert any(name.endswith("/package.xml") for name in content.getnames()), archive.name


@pytest.mark.timeout(900)
def test_the_licence_is_in_every_wheel_and_every_source_archive_and_no_dead_address_is(wheels: Path) -> None:
    licence = (PROJECT / "LICENSE").read_bytes()
    for archive in (wheels.parent / "archives").glob("*.tar.gz"):
        with tarfile.open(archive) as content:
            texts = [
                m for m in content.getmembers() if m.isfile() and m.name.count("/") == 1 and m.name.endswith("/LICENSE")
            ]
            files = [content.extractfile(member) for member in texts]
            assert [file.read() for file in files if file is not None] == [licence], archive.name
    for wheel in wheels.glob("*.whl"):
        with zipfile.ZipFile(wheel) as held:
            names = [name for name in held.namelist() if ".dist-info/" in name and name.endswith("/LICENSE")]
            assert [held.read(name) for name in names] == [licence], wheel.name
            (metadata,) = (name for name in held.namelist() if name.endswith(".dist-info/METADATA"))
            assert b"email:" not in held.read(metadata), wheel.name
    for folder in FOLDERS:
        assert (PROJECT / folder / "LICENSE").read_bytes() == licence, folder


@pytest.mark.timeout(900)
def test_what_the_wheels_install_comes_from_an_experiment_to_its_report_with_the_first_layer_alone(
    wheels: Path, domain_id: int, tmp_path: Path
) -> None:
    """The one in simulated time, whose bags go through the same comparison and report; nothing waits for a clock."""
    place = tmp_path / "place"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install"]
    # What is never imported need not be compiled.
    pip += ["--no-deps", "--no-index", "--no-compile"]
    _run(*pip, "--target", place, *sorted(wheels.glob("*.whl")), cwd=tmp_path)
    env = environment_of(tmp_path / "hide", "run")
    env["PYTHONPATH"] = f"{place}:{env['PYTHONPATH']}"
    where = _run(sys.executable, "-c", "import pendulum_bags; print(pendulum_bags.__file__)", cwd=tmp_path, env=env)
    assert Path(where.strip()).is_relative_to(place)

    kept = _bring_compiled_loops(place)
    run = [sys.executable, "-m", "pendulum_bags"]
    for side in ("sim", "hw"):
        _run(*run, "experiment", "lockstep", "--side", side, "--bag", side, "--duration", "1", cwd=tmp_path, env=env)
    assert len(read_bag(tmp_path / "sim")["/sim/joint_states"]) == 501
    assert {path: path.stat().st_ino for path in kept} == kept
    assert list(place.glob("pendulum_lqr/__pycache__/uniform_loop-*.loop"))
    _run(*run, "report", "sim", "hw", "--out", "report", cwd=tmp_path, env=env)
    (page,) = (tmp_path / "report").glob("*.html")
    assert "plotly-packed" in page.read_text(encoding="utf-8")
    assert list((tmp_path / "report").rglob("*.png"))


def _bring_compiled_loops(place: Path) -> dict[Path, int]:
    """Bring all loops but the disturbance's, compiled of the same source, and return them with their numbers.

    That one, the smallest, is left to what is installed: to compile them all takes half a minute.
    """
    brought = {}
    for builder, *choice in COMMON:
        keep_loop(builder, *choice)
    for folder in FOLDERS:
        for path in (PROJECT / folder).glob("pendulum_*/__pycache__/*.loop"):
            if not path.name.startswith("uniform_loop"):
                to = place / path.relative_to(PROJECT / folder)
                to.parent.mkdir(exist_ok=True)
                shutil.copyfile(path, to)
                brought[to] = to.stat().st_ino
    assert len(brought) >= 4
    return brought
