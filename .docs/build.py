"""Build the site into ``build/site`` from the Markdown files where they stand, with their pictures."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
GATHERED = PROJECT / "build" / "docs"
PACKAGES = ("pendulum_sim", "pendulum_hw_bridge", "pendulum_lqr", "pendulum_rosbag", "pendulum_bags")
NODES = (
    ("simulator", "pendulum_sim.simulator_node", ("SPECS",)),
    ("viewer", "pendulum_sim.viewer_node", ("SPECS",)),
    ("markers", "pendulum_sim.markers_node", ("SPECS",)),
    ("bridge", "pendulum_hw_bridge.bridge_node", ("SPECS",)),
    ("disturbance", "pendulum_lqr.disturbance_node", ("DISTURBANCE_SPECS", "NODE_SPECS")),
    ("effort_adapter", "pendulum_lqr.effort_adapter_node", ("NODE_SPECS",)),
    ("recorder", "pendulum_rosbag.recorder.recorder_node", ("SPECS",)),
    ("play", "pendulum_rosbag.player.player_node", ("SPECS",)),
)
"""Node, module, its tables of parameters."""


def reference() -> str:
    """Return the reference page, from the tables that the programs themselves read."""
    from pendulum_lqr.bringup import ARGUMENTS
    from pendulum_lqr.controller import COMMON_PARAMETERS, CONTROLLERS, controller_class
    from pendulum_msgs_py.parameters import markdown_table
    from pendulum_msgs_py.programs.executables import summary

    parts = [
        "# Reference\n\nGenerated from the code: what stands here is what the programs read.\n\n## Programs\n"
    ]
    for package in PACKAGES:
        tables = importlib.import_module(f"{package}.executables")
        for name, target in {**tables.EXECUTABLES, **getattr(tables, "COMMANDS", {})}.items():
            parts.append(f"- `python -m {package} {name}`: {summary(name, target)}.")
    parts.append("\n## Parameters of the nodes\n")
    for name, module, tables in NODES:
        specs = [spec for table in tables for spec in getattr(importlib.import_module(module), table)]
        parts.append(f"### {name}\n\n{markdown_table(specs)}\n")
    node = importlib.import_module("pendulum_lqr.controller_node").NODE_SPECS
    parts.append(f"### controller\n\n{markdown_table([*node, *COMMON_PARAMETERS])}\n\n## Controllers\n")
    for name in CONTROLLERS:
        own = controller_class(name)
        table = markdown_table(own.PARAMETERS) if own.PARAMETERS else "No parameters of its own."
        parts.append(f"### {name}\n\n{own.SUMMARY}.\n\n{table}\n")
    parts.append(
        "## Arguments of `bringup.launch.py`\n\n| argument | default | choices | meaning |\n|---|---|---|---|"
    )
    parts += [
        f"| `{it.name}` | `{it.default or chr(34) * 2}` | {', '.join(it.choices) or 'any'} | {it.description} |"
        for it in ARGUMENTS
    ]
    return "\n".join(parts) + "\n"


def main() -> int:
    """Gather the pages that git knows, or would add, and run mkdocs on them."""
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
        shutil.copyfile(PROJECT / name, target)
    (GATHERED / "reference.md").write_text(reference(), encoding="utf-8")
    configuration = str(PROJECT / ".docs" / "mkdocs.yml")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--config-file", configuration]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    code = subprocess.run(command, cwd=PROJECT, env=environment, check=False).returncode
    if code == 0:
        print("the site is build/site/index.html")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
