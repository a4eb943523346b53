"""The rooms of each package: each says what is in it, the README lists them in these words, and none is a drawer."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS

_MOST_FILES = 40
"""More modules than this in one folder, and nobody finds the right one by looking."""
_FOR_ALL = {
    "pendulum_msgs_py": {"errors", "json_values", "parameters", "whole_file"},
    "pendulum_bags": {"arrays", "distributions", "pendulum_cli"},
}


def _rooms(package: str) -> list[Path]:
    inits = (PROJECT / FOLDERS[package] / package).rglob("__init__.py")
    return sorted(path.parent for path in inits if path.parent.name != package)


def _sentence(room: Path) -> str:
    told = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8"))) or ""
    # READMEs are Markdown: a role of Sphinx is set as code there.
    return re.sub(r":\w+:`([^`]*)`", r"`\1`", " ".join(told.split("\n\n")[0].split())).replace("``", "`")


@pytest.mark.parametrize("package", FOLDERS)
def test_a_readme_lists_the_rooms_of_its_package_in_their_own_words(package: str) -> None:
    root = PROJECT / FOLDERS[package]
    lines = [
        f"| [`{room.relative_to(root / package)}/`]({room.relative_to(root)}) | {_sentence(room)} |"
        for room in _rooms(package)
    ]
    expected = "\n".join(["| room | what is in it |", "|---|---|", *lines])
    readme = (root / "README.md").read_text(encoding="utf-8")
    found = re.search(r"<!-- table: rooms -->\n\n(.*?)\n<!-- end -->", readme, re.DOTALL)
    assert (found[1].strip() if found else "") == expected, f"expected in {root.name}/README.md:\n{expected}"


@pytest.mark.parametrize("package", FOLDERS)
def test_modules_lie_in_rooms_but_for_the_few_that_all_rooms_need(package: str) -> None:
    beside = {path.stem for path in (PROJECT / FOLDERS[package] / package).glob("*.py")}
    assert beside <= {"__init__", "__main__", "executables"} | _FOR_ALL.get(package, set())


@pytest.mark.parametrize("package", FOLDERS)
def test_no_room_is_a_drawer(package: str) -> None:
    for room in [PROJECT / FOLDERS[package] / package, *_rooms(package)]:
        assert len(list(room.glob("*.py"))) <= _MOST_FILES, f"{room} holds more files than a room should"
