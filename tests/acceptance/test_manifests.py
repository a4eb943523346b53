"""rosdep brings what the packages import; the page says where the rest comes from; nothing is named in vain."""

from __future__ import annotations

import ast
import configparser
import re
import shlex
import sys
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS
from tests.layers import pins

KNOWN: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("rosdep_keys.yaml").read_text(encoding="utf-8"))
PAGE = (PROJECT / "pendulum_msgs_py" / "docs" / "install.md").read_text(encoding="utf-8")
_OF_ROS = re.compile(r"rclpy|launch|launch_ros|std_srvs|\w+_interfaces|\w+_msgs|pendulum_\w+")


@cache
def imported(package: str) -> frozenset[str]:
    """Return the modules of others that a package imports, anywhere in its code; to read all of it takes seconds."""
    found: set[str] = set()
    for path in (PROJECT / FOLDERS[package] / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found.update(alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                found.add(node.module.split(".")[0])
    return frozenset(name for name in found if name not in sys.stdlib_module_names and not _OF_ROS.fullmatch(name))


def required(package: str) -> set[str]:
    """Return the distributions that a package cannot do without."""
    config = configparser.ConfigParser()
    config.read(PROJECT / FOLDERS[package] / "setup.cfg")
    return {re.split(r"[\[<>=]", line)[0] for line in config["options"]["install_requires"].split()}


def keys(package: str, kind: str) -> set[str]:
    """Return the dependencies of a kind that are no packages of ROS."""
    manifest = ElementTree.parse(PROJECT / FOLDERS[package] / "package.xml")
    named = {str(element.text) for element in manifest.iter(kind)}
    return {name for name in named if re.match(r"python|.*-pip$", name)}


@pytest.mark.parametrize("package", FOLDERS)
def test_the_manifest_names_the_key_of_every_library_and_no_other(package: str) -> None:
    of_module = {entry["module"]: key for key, entry in KNOWN["keys"].items()}
    libraries = imported(package)
    unknown = libraries - of_module.keys() - KNOWN["pip_only"].keys()
    assert not unknown, f"look up the rosdep keys of {unknown}, as rosdep_keys.yaml says"
    # No package of a distribution may depend on one of pip: such a key stands where nothing runs without its library.
    wanted = {of_module[name] for name in libraries & of_module.keys()}
    optional = {key for key in wanted if key.endswith("-pip") and KNOWN["keys"][key]["pip"] not in required(package)}
    assert keys(package, "exec_depend") == wanted - optional
    assert keys(package, "test_depend") == set(KNOWN["test_keys"])


def test_the_page_installs_what_rosdep_has_no_key_for() -> None:
    (line,) = re.findall(r"^.*pip install (SALib .*)$", PAGE, re.MULTILINE)
    named = {re.split("[<>=]", requirement)[0] for requirement in shlex.split(line)}
    needed = set().union(*(required(package) for package in FOLDERS))
    by_pip = {entry["pip"] for entry in KNOWN["keys"].values() if "pip" in entry}
    assert named == set(KNOWN["pip_only"].values()) | (by_pip - needed)
    used = frozenset().union(*(imported(package) for package in FOLDERS))
    assert KNOWN["pip_only"].keys() <= used
    assert {entry["module"] for entry in KNOWN["keys"].values()} <= used


def test_what_the_page_misses_on_other_machines_stands_in_that_layer_of_the_lock() -> None:
    rows = re.findall(r"^\| `(run|extras)` \|(.*)$", PAGE, re.MULTILINE)
    assert [layer for layer, _ in rows] == ["run", "extras"]
    for layer, cells in rows:
        named = set(re.findall(r"`([a-z0-9-]+)`", cells))
        assert named
        assert named <= {pin.name for pin in pins(layer)}
