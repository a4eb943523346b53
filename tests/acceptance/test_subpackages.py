"""The subpackages: each states its content, the README lists these sentences, and none is too large."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS

_MOST_FILES = 40
"""A folder of more modules is hard to search."""
_FOR_ALL = {
    "pendulum_msgs_py": {"errors", "json_values", "parameters", "atomic_write"},
    "pendulum_bags": {"arrays", "distributions"},
}


def _subpackages(package: str) -> list[Path]:
    inits = (PROJECT / FOLDERS[package] / package).rglob("__init__.py")
    return sorted(path.parent for path in inits if path.parent.name != package)


def _sentence(folder: Path) -> str:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    # READMEs are Markdown: a role of Sphinx is set as code there.
    return re.sub(r":\w+:`([^`]*)`", r"`\1`", " ".join(text.split("\n\n")[0].split())).replace("``", "`")


@pytest.mark.parametrize("package", FOLDERS)
def test_a_readme_lists_the_subpackages_in_their_own_words(package: str) -> None:
    root = PROJECT / FOLDERS[package]
    lines = [
        f"| [`{folder.relative_to(root / package)}/`]({folder.relative_to(root)}) | {_sentence(folder)} |"
        for folder in _subpackages(package)
    ]
    # A small package has no subpackages.
    expected = "\n".join(["| subpackage | content |", "|---|---|", *lines]) if lines else ""
    readme = (root / "README.md").read_text(encoding="utf-8")
    found = re.search(r"<!-- table: subpackages -->\n\n(.*?)\n<!-- end -->", readme, re.DOTALL)
    assert (found[1].strip() if found else "") == expected, f"expected in {root.name}/README.md:\n{expected}"


@pytest.mark.parametrize("package", FOLDERS)
def test_modules_lie_in_subpackages_except_those_that_all_need(package: str) -> None:
    beside = {path.stem for path in (PROJECT / FOLDERS[package] / package).glob("*.py")}
    assert not _subpackages(package) or beside <= {"__init__", "__main__", "executables"} | _FOR_ALL.get(package, set())


@pytest.mark.parametrize("package", FOLDERS)
def test_no_subpackage_is_too_large(package: str) -> None:
    for folder in [PROJECT / FOLDERS[package] / package, *_subpackages(package)]:
        assert len(list(folder.glob("*.py"))) <= _MOST_FILES, f"{folder} holds more files than a subpackage should"
