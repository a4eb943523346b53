"""Which extra of a package installs a missing library."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["PACKAGES", "extra_of", "how_to_install"]

PACKAGES = (
    "pendulum_msgs_py", "pendulum_rosbag", "pendulum_sim", "pendulum_lqr", "pendulum_hw_bridge", "pendulum_bags",
    "pendulum_console", "pendulum_learning", "pendulum_course",
)  # fmt: skip
_DISTRIBUTIONS = {
    "foxglove": "foxglove-sdk",
    "hebi": "hebi-py",
    "dynamixel_sdk": "dynamixel-sdk",
    "PIL": "pillow",
    "dask": "distributed",
}
"""Distributions whose name differs from the module's."""
_REQUIREMENT = re.compile(r"^([A-Za-z0-9._-]+)[^;]*(?:;.*extra\s*==\s*[\"']([\w-]+)[\"'])?")


def extra_of(module: str) -> str:
    """Return the extra that installs a module, as ``pendulum_console``, its package, or an empty string."""
    # Imported late: few programs lack a library.
    from importlib.metadata import PackageNotFoundError, requires

    top = module.partition(".")[0]
    wanted = {_plain(name) for name in (_DISTRIBUTIONS.get(top, top), f"ros-{top}", f"ros-jazzy-{top}")}
    for package in PACKAGES:
        try:
            entries = requires(package) or []
        except PackageNotFoundError:
            continue
        for entry in entries:
            found = _REQUIREMENT.match(entry)
            if found and _plain(found[1]) in wanted:
                return f"{package}[{found[2]}]" if found[2] else package
    return ""


def how_to_install(error: ImportError) -> str:
    """Return a sentence on how to install the missing library, or where an own module moved to; empty for others."""
    module = error.name if isinstance(error, ModuleNotFoundError) else None
    if module and (package := module.partition(".")[0]) in PACKAGES and (place := _place_of(package)) is not None:
        # The import uses a module's name of an earlier version.
        now = sorted(
            f"{package}.{path.parent.name}.{path.stem}" for path in place.glob(f"*/{module.split('.')[-1]}.py")
        )
        return f"{module} is {' or '.join(now)} now" if now else ""
    extra = extra_of(module) if module else ""
    if not module or not extra:
        return ""
    missing = f"{module.partition('.')[0]} is not installed, which this needs"
    if extra.endswith("[ros]"):
        return f"{missing}; install ROS 2 Jazzy, or its wheels for Linux on x86_64: python -m pip install '{extra}'"
    return f"{missing}; install it with make extras, or python -m pip install '{extra}'"


def _place_of(package: str) -> Path | None:
    from importlib.util import find_spec

    spec = find_spec(package)
    return None if spec is None or spec.origin is None else Path(spec.origin).parent


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
