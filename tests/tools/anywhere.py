"""Where the lock and the wheels of this project can be installed, found out by installing them.

It asks the package index whether all packages of a layer have wheels, for each system and version of Python; then it
installs ``pendulum_bags`` into an empty environment of every given CPython, and compares the example recordings there::

    python -m tests.tools.anywhere [PYTHON ...]

It exits with code 1 where a wheel of this project is not pure, or a program fails. ``make lock`` brings ``uv``.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS
from tests.layers import ROOM

UV = Path(sys.prefix, ".uv", "bin", "uv")
SYSTEMS = {
    "Linux x86_64": "x86_64-manylinux_2_35",
    "Linux arm64": "aarch64-manylinux_2_35",
    "macOS arm64": "aarch64-apple-darwin",
    "Windows": "x86_64-pc-windows-msvc",
    "macOS x86_64": "x86_64-apple-darwin",
}
VERSIONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
_NO_WHEEL = re.compile(r"Because ([\w.-]+?)(?:\{.*?\})?==\S+ has no ")


def without_wheel(layer: str, system: str, version: str) -> list[str]:
    """Return the locked packages of a layer that have no wheel for a system and a version of Python."""
    entries = re.split(r"(?m)^(?=[A-Za-z0-9])", (ROOM / f"{layer}.txt").read_text(encoding="utf-8"))
    missing: list[str] = []
    while True:
        with tempfile.TemporaryDirectory() as folder:
            lock = Path(folder, "lock.txt")
            lock.write_text("".join(entry for entry in entries if entry.partition("==")[0] not in missing), "utf-8")
            what = f"--python-platform {SYSTEMS[system]} --python-version {version} --target {folder}/target -r {lock}"
            how = f"--dry-run --quiet --only-binary :all: --no-deps --require-hashes --python {sys.executable}"
            done = subprocess.run(
                [UV, "pip", "install", *how.split(), *what.split()],
                capture_output=True,
                text=True,
                check=False,
            )
        if done.returncode == 0:
            return missing
        found = _NO_WHEEL.search(done.stderr)
        if not found:
            raise RuntimeError(done.stderr)
        missing.append(found[1])


def run_alone(python: str, dist: Path, folder: Path) -> str:
    """Install pendulum_bags into an empty environment, compare the examples there, and return the outcome."""
    subprocess.run([UV, "venv", "--quiet", "--python", python, folder], check=True)
    asked = f"--quiet --only-binary :all: --find-links {dist} --constraint {ROOM / 'run.txt'} pendulum_bags"
    subprocess.run([UV, "pip", "install", "--python", folder / "bin" / "python", *asked.split()], check=True)
    recordings = [PROJECT / "bags" / "examples" / f"regulation_{side}" for side in ("sim", "hw")]
    done = subprocess.run(
        [folder / "bin" / "pendulum", "compare", *recordings, "--json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
    )
    return str(json.loads(done.stdout)["verdict"]["outcome"])


def main() -> int:
    """Print both tables."""
    for layer in ("run", "extras"):
        for system in SYSTEMS:
            for version in VERSIONS:
                missing = without_wheel(layer, system, version)
                told = f"no wheel of {', '.join(missing)}" if missing else "all"
                print(f"{layer:7} {system:13} {version:5} {told}", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        dist = Path(scratch, "dist")
        places = [PROJECT / folder for folder in FOLDERS.values()]
        build = f"-m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir {dist}".split()
        for place in places:
            # A copy: pip builds in place, and leaves there what the next build would take for its own.
            source = shutil.copytree(
                place, Path(scratch, place.name), ignore=shutil.ignore_patterns("build", "*.egg-info")
            )
            subprocess.run([sys.executable, *build, source], check=True)
        if impure := [path.name for path in dist.iterdir() if not path.name.endswith("-py3-none-any.whl")]:
            print("not pure:", *impure)
            return 1
        for number, python in enumerate(sys.argv[1:]):
            print(python, run_alone(python, dist, Path(scratch, f"environment_{number}")), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
