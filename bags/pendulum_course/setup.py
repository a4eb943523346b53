"""Build script of this package: the same file in all packages, since what differs stands in the files beside it.

``package.xml`` says who we are, ``<package>/executables.py`` which programs there are; nothing is said twice.
"""

import ast
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

DATA_ENDINGS = ["css", "csv", "html", "j2", "js", "json", "md", "npz", "png", "svg", "toml", "woff2", "xml", "yaml"]


def read_executables(path: Path) -> dict[str, str]:
    """Read the table of programs without importing the package: a build has none of its dependencies."""
    if not path.is_file():
        return {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        if any(getattr(target, "id", None) == "EXECUTABLES" for target in targets):
            table: dict[str, str] = ast.literal_eval(node.value)
            return table
    return {}


def share_files(name: str) -> list[tuple[str, list[str]]]:
    """List what ROS tools look for in the package's share folder."""
    folders = [
        folder
        for top in ("launch", "config", "urdf", "rviz", "worlds", "meshes")
        for folder in [Path(top), *sorted(Path(top).rglob("*"))]
        if folder.is_dir() and folder.name != "__pycache__"
    ]
    files = [(folder, sorted(str(file) for file in folder.iterdir() if file.is_file())) for folder in folders]
    return [(f"share/{name}/{folder}", names) for folder, names in files if names]


# For ``ros2 run`` colcon puts programs into a folder of the package; pip puts them where all commands are,
# and must not put ``record``, ``play`` or ``info`` before those of others.
PREFIX = "pendulum-" if {"bdist_wheel", "dist_info", "editable_wheel"} & set(sys.argv) else ""
# One of them lists and starts all others, and has the name to itself.
ALL = "pendulum"

manifest = ElementTree.parse("package.xml")
name = manifest.findtext("name", "")
executables = read_executables(Path(name, "executables.py"))
SCRIPTS = [f"{PREFIX * (program != ALL)}{program} = {target}" for program, target in executables.items()]
setup(
    name=name,
    version=manifest.findtext("version", ""),
    description=" ".join(manifest.findtext("description", "").split()),
    license=manifest.findtext("license", ""),
    maintainer=manifest.findtext("maintainer", ""),
    packages=find_packages(include=[name, f"{name}.*"]),
    # What the package reads at run time beside its modules: presets, templates, pages; and the typing marker.
    package_data={"": [f"**/*.{ending}" for ending in DATA_ENDINGS] + ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml", "LICENSE", "CHANGELOG.rst"]),
        *share_files(name),
    ],
    entry_points={"console_scripts": SCRIPTS} if SCRIPTS else {},
    zip_safe=False,
)
