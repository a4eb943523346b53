"""Build the site into ``build/site`` from the Markdown files where they stand, with their pictures."""

from __future__ import annotations

import importlib
import io
import os
import posixpath
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pendulum_msgs_py.parameters import ParameterSpec

PROJECT = Path(__file__).resolve().parents[1]
GATHERED = PROJECT / "build" / "docs"
REFERENCE = PROJECT / "pendulum_msgs_py" / "docs" / "reference.md"
PACKAGES = (
    "pendulum_sim",
    "pendulum_hw_bridge",
    "pendulum_lqr",
    "pendulum_rosbag",
    "pendulum_bags",
    "pendulum_console",
    "pendulum_learning",
    "pendulum_course",
)
NODES = (
    ("simulator", "pendulum_sim.simulator.simulator_node", ("SPECS",)),
    ("mujoco", "pendulum_sim.simulator.engines", ("MUJOCO",)),
    ("fmu", "pendulum_sim.simulator.engines", ("FMU",)),
    ("gymnasium", "pendulum_sim.simulator.engines", ("GYMNASIUM",)),
    ("adopt", "pendulum_sim.simulator.adopt_node", ("SPECS",)),
    ("viewer", "pendulum_sim.pictures.viewer_node", ("SPECS",)),
    ("markers", "pendulum_sim.pictures.markers_node", ("SPECS",)),
    ("bridge", "pendulum_hw_bridge.bridge.node_specs", ("SPECS",)),
    ("disturbance", "pendulum_lqr.disturbances.disturbance_node", ("DISTURBANCE_SPECS", "NODE_SPECS")),
    ("effort_adapter", "pendulum_lqr.nodes.effort_adapter_node", ("NODE_SPECS",)),
    ("trajectory_action", "pendulum_lqr.nodes.trajectory_action_node", ("NODE_SPECS",)),
    ("recorder", "pendulum_rosbag.recorder.recorder_node", ("SPECS",)),
    ("play", "pendulum_rosbag.player.player_node", ("SPECS",)),
)
"""Node, module, its tables of parameters, or what has one as ``specs``."""
_CODE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(?<!!)\[([^\[\]]+)\]\(([^()\s]+)\)")
_MATHS = re.compile(r"\A```math\n(.*?)\n```\Z", re.DOTALL)


def drawn(formula: str) -> str:
    """Return a formula as an image that is part of the page: nothing is fetched, and it takes the colour of the text.

    On GitHub the same block (a fence called ``math``) is set by MathJax.

    Args:
        formula: LaTeX, in the part of it that matplotlib's mathtext knows.

    Returns:
        HTML.
    """
    from matplotlib import mathtext, rc_context

    buffer = io.BytesIO()
    with rc_context({"mathtext.fontset": "cm", "svg.fonttype": "path", "font.size": 14}):
        mathtext.math_to_image(f"${formula}$", buffer, format="svg")
    image = buffer.getvalue().decode()
    image = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", image[image.index("<svg") :], flags=re.DOTALL)
    # The background would hide the page's own, and black glyphs are not seen on a dark one.
    image = re.sub(r'<g id="patch_1">.*?</g>', "", image, count=1, flags=re.DOTALL)
    image = image.replace("<svg ", '<svg fill="currentColor" aria-hidden="true" ', 1)
    label = formula.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    # One line without blanks at its ends: Markdown takes it as it is.
    image = " ".join(image.split())
    return f'<div class="formula" role="img" aria-label="{label}">{image}</div>'


def for_the_site(text: str, page: str, gathered: set[str]) -> str:
    """Return a page with its formulas drawn, and with the names of files where it links to what is not on the site.

    Args:
        text: Markdown.
        page: The page's path in the repository.
        gathered: Paths of the files that are on the site.

    Returns:
        Markdown.
    """

    def named(link: re.Match[str]) -> str:
        label, target = link.group(1), link.group(2).partition("#")[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        if not target or ":" in target or path in gathered:
            return link.group(0)
        plain = label.strip("`")
        return f"`{path}`" if path.endswith(plain) or plain.endswith(path) else f"{label} (`{path}`)"

    parts = _CODE.split(text)
    for i, part in enumerate(parts):
        maths = _MATHS.match(part)
        if maths:
            parts[i] = drawn(maths.group(1))
        elif i % 2 == 0:
            parts[i] = _LINK.sub(named, part)
    return "".join(parts)


def _tables(tables: Mapping[str, tuple[str, list[str]]], shared: str) -> list[str]:
    """Return a section for each table; rows that several have stand once, in a section of their own.

    Args:
        tables: Heading, with a sentence and the rows.
        shared: Heading of the rows that several tables have.

    Returns:
        Markdown, in parts.
    """
    from pendulum_msgs_py.parameters import markdown_table

    head = markdown_table([])
    count = Counter(row for _, rows in tables.values() for row in rows)
    common = [row for row, tables_with_it in count.items() if tables_with_it > 1]
    note = "What the sections below only name is described here."
    parts = [f"### {shared}\n\n{note}\n\n{head}" + "\n".join(common) + "\n"] if common else []
    for heading, (sentence, rows) in tables.items():
        own = [row for row in rows if count[row] == 1]
        names = ", ".join(row.split(" ")[1].rstrip("*") for row in rows if count[row] > 1)
        parts.append(f"### {heading}\n")
        parts += [f"{sentence}.\n"] if sentence else []
        parts += [head + "\n".join(own) + "\n"] if own else []
        parts += [f"{'Also' if own else 'Parameters'}: {names}.\n"] if names else []
        parts += [] if rows else ["No parameters of its own.\n"]
    return parts


def _programs() -> list[str]:
    """Return a line for each program; those that a package offers of another are named only."""
    from pendulum_msgs_py.programs.executables import summary

    parts: list[str] = []
    seen: dict[str, str] = {}
    for package in PACKAGES:
        module = importlib.import_module(f"{package}.executables")
        table = {**module.EXECUTABLES, **getattr(module, "COMMANDS", {})}
        said = {name: summary(name, target) for name, target in table.items()}
        parts.append(f"\n`python -m {package} ...`\n")
        parts += [f"- `{name}`: {text}." for name, text in said.items() if seen.get(name) != text]
        again = ", ".join(f"`{name}`" for name, text in said.items() if seen.get(name) == text)
        parts += [f"- {again}, as above."] if again else []
        seen |= said
    return parts


def reference() -> str:
    """Return the reference page, from the tables that the programs themselves read."""
    from pendulum_hw_bridge.drive.safety import FAULTS
    from pendulum_lqr.controller_interface.controller import COMMON_PARAMETERS, controller_class, controller_names
    from pendulum_lqr.nodes.bringup import ARGUMENTS
    from pendulum_msgs_py.parameters import markdown_table
    from pendulum_msgs_py.plants.joint_parameters import DRIVETRAIN_SPECS
    from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, load_mechanism

    def table_rows(specs: Iterable[ParameterSpec]) -> list[str]:
        return markdown_table(specs).splitlines()[2:]

    parts = [
        "# Reference\n\nGenerated from the code by `python .docs/build.py --reference`; a test compares it.\n",
        "Parameters with a star are read-only: they are set at the start.\n",
        "## Programs",
        *_programs(),
        "\n## Parameters of the nodes\n",
    ]
    nodes: dict[str, tuple[str, list[str]]] = {}
    for name, module, tables in NODES:
        found = [getattr(importlib.import_module(module), table) for table in tables]
        nodes[name] = ("", table_rows(spec for table in found for spec in getattr(table, "specs", table)))
    node = importlib.import_module("pendulum_lqr.nodes.controller_node").NODE_SPECS
    nodes["controller"] = ("", table_rows([*node, *COMMON_PARAMETERS]))
    parts += _tables(nodes, "Shared by several nodes")
    classes = {name: controller_class(name) for name in controller_names()}
    parts.append("## Controllers\n")
    parts += _tables(
        {name: (own.SUMMARY, table_rows(own.parameters(None))) for name, own in classes.items()},
        "Shared by several controllers",
    )
    parts.append("## Controllers of several joints\n\nParameters as for the preset `cart_pole`.\n")
    mechanism = load_mechanism("cart_pole")
    joint = {name: controller_class(name, mechanism) for name in controller_names(several=True)}
    tables_of_joints = {
        f"{name}, several joints": (own.SUMMARY, table_rows(own.parameters(mechanism))) for name, own in joint.items()
    }
    parts += _tables(tables_of_joints, "Shared by several of these")
    parts.append("## Faults of the bridge\n\n| fault | meaning |\n|---|---|")
    parts += [f"| `{name}` | {meaning} |" for name, meaning in FAULTS.items()]
    parts += ["\n## Plant files\n", *_tables({"plant": ("", table_rows(PLANT_SPECS))}, "")]
    parts += _tables({"drivetrain": ("", table_rows(DRIVETRAIN_SPECS))}, "")
    parts.append("## Arguments of `bringup.launch.py`\n\n| argument | default | choices | meaning |\n|---|---|---|---|")
    parts += [
        f"| `{it.name}` | `{it.default or chr(34) * 2}` | {', '.join(it.choices) or 'any'} | {it.description} |"
        for it in ARGUMENTS
    ]
    return "\n".join(parts) + "\n"


def main() -> int:
    """Gather the pages that git knows, or would add, and run mkdocs on them; ``--reference`` renews that page alone."""
    if sys.argv[1:] == ["--reference"]:
        REFERENCE.write_text(reference(), encoding="utf-8")
        return 0
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md", "*.png", "*.svg", "*.gif"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    if "README.md" not in listed:
        print(
            "error: README.md is missing; expected the first page of the site there",
            file=sys.stderr,
        )
        return 2
    shutil.rmtree(GATHERED, ignore_errors=True)
    for name in listed:
        target = GATHERED / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".md"):
            text = (PROJECT / name).read_text(encoding="utf-8")
            target.write_text(for_the_site(text, name, set(listed)), encoding="utf-8")
        else:
            shutil.copyfile(PROJECT / name, target)
    shutil.copyfile(PROJECT / ".docs" / "formula.css", GATHERED / "formula.css")
    configuration = str(PROJECT / ".docs" / "mkdocs.yml")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--config-file", configuration]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    code = subprocess.run(command, cwd=PROJECT, env=environment, check=False).returncode
    if code == 0:
        print("the site is build/site/index.html (its search needs a server: python -m http.server -d build/site)")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
