"""Build script of this package: the same file in all packages, since what differs is in the files next to it.

``package.xml`` describes the package, ``<package>/executables.py`` lists its programs; nothing is stated twice.
"""

import runpy
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

DATA_ENDINGS = ["css", "csv", "html", "j2", "js", "json", "md", "npz", "png", "svg", "toml", "woff2", "xml", "yaml"]
# For ``ros2 run`` colcon puts programs into a folder of the package; pip puts them where all commands are,
# and must not put ``record``, ``play`` or ``info`` before those of others.
PREFIX = "pendulum-" if {"bdist_wheel", "dist_info", "editable_wheel"} & set(sys.argv) else ""
# One of them lists and starts all others, and has the name to itself.
ALL = "pendulum"

manifest = ElementTree.parse("package.xml")
name = manifest.findtext("name", "")
table = Path(name, "executables.py")
# Not imported: a build has none of the package's dependencies, and this file needs none.
executables = runpy.run_path(str(table))["EXECUTABLES"] if table.is_file() else {}
SCRIPTS = [f"{PREFIX * (program != ALL)}{program} = {target}" for program, target in executables.items()]
# What ROS tools look for in the package's share folder.
shared = [file for top in ("config", "launch", "rviz") for file in Path(top).rglob("*.*") if file.suffix != ".pyc"]
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
        *((f"share/{name}/{file.parent}", [str(file)]) for file in sorted(shared) if file.is_file()),
    ],
    entry_points={"console_scripts": SCRIPTS} if SCRIPTS else {},
    zip_safe=False,
)
