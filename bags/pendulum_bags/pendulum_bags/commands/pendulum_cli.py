"""``pendulum``: start any program of the project by its name, listed by purpose."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.executables import (
    answer_of_dispatcher,
    is_installed,
    report_error,
    run_program,
    summary,
    tables_of,
)

__all__ = ["SECTIONS", "main"]

SECTIONS: dict[str, dict[str, str]] = {
    "Is a simulation good enough to design a controller on?": {
        "experiment": "pendulum_bags experiment",
        "compare": "pendulum_bags compare",
        "frequency_response": "pendulum_bags frequency_response",
        "ranking": "pendulum_bags ranking",
        "study": "pendulum_bags study",
        "report": "pendulum_bags report",
        "analyse": "pendulum_bags analyse",
    },
    "Parameters and controllers": {
        "excite": "pendulum_bags excite",
        "identify": "pendulum_bags identify",
        "replay": "pendulum_bags replay",
        "design": "pendulum_lqr design",
        "swing_up": "pendulum_lqr swing_up",
        "train": "pendulum_learning train",
        "convert_policy": "pendulum_lqr convert_policy",
    },
    "See, move and stop what runs": {
        "console": "pendulum_console console",
        "foxglove": "pendulum_console foxglove",
        "move": "pendulum_bags move",
        "viewer": "pendulum_sim viewer",
        "phase_plot": "pendulum_sim phase_plot",
        "markers": "pendulum_sim markers",
    },
    "Plants": {
        "simulator": "pendulum_sim simulator",
        "mujoco": "pendulum_sim mujoco",
        "fmu": "pendulum_sim fmu",
        "gymnasium": "pendulum_sim gymnasium",
        "adopt": "pendulum_sim adopt",
        "bridge": "pendulum_hw_bridge bridge",
        "export_model": "pendulum_sim export_model",
    },
    "Commanding a plant": {
        "controller": "pendulum_lqr controller",
        "disturbance": "pendulum_lqr disturbance",
        "effort_adapter": "pendulum_lqr effort_adapter",
        "trajectory_action": "pendulum_lqr trajectory_action",
    },
    "A real actuator, and one that is emulated": {
        "scan": "pendulum_hw_bridge scan",
        "lab": "pendulum_hw_bridge lab",
        "check": "pendulum_hw_bridge check",
        "procedure": "pendulum_hw_bridge procedure",
        "emulator": "pendulum_hw_bridge emulator",
        "emulator_fault": "pendulum_hw_bridge emulator_fault",
        "emulator_hand": "pendulum_hw_bridge emulator_hand",
        "convert_log": "pendulum_hw_bridge convert",
    },
    "Recordings": {
        "record": "pendulum_bags record",
        "play": "pendulum_bags play",
        "info": "pendulum_bags info",
        "export": "pendulum_bags export",
        "repair": "pendulum_bags repair",
        "convert": "pendulum_bags convert",
        "merge": "pendulum_bags merge",
        "cut": "pendulum_bags cut",
        "filter": "pendulum_bags filter",
    },
    "Teach": {"course": "pendulum_course course"},
}
"""Heading -> command -> package and program."""
_EXAMPLES = (
    "pendulum experiment thesis --seed 7",
    "pendulum compare bags/examples/regulation_sim bags/examples/regulation_hw",
    "pendulum design --preset thesis",
    "pendulum simulator --ros-args -r __ns:=/sim -p plant:=x5_9",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pendulum COMMAND ARGUMENTS`` untouched, importing that program alone, and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = {name: target for section in SECTIONS.values() for name, target in section.items()}
    code = answer_of_dispatcher(
        arguments,
        commands,
        usage=_help,
        unknown=lambda name: f"there is no command {name!r}; expected one that pendulum --help lists",
    )
    if code is not None:
        return code
    name, *rest = arguments
    package, program = commands[name].split()
    if not is_installed(package):
        return report_error(
            ParameterError(
                f"{package} is not installed, which {name} is in; install it: python -m pip install {package}"
            )
        )
    return run_program(tables_of(package)[program], rest, called_as=f"pendulum {name}")


def _help() -> str:
    width = max(len(name) for section in SECTIONS.values() for name in section)
    lines = ["usage: pendulum COMMAND [ARGUMENTS]"]
    for heading, section in SECTIONS.items():
        lines += ["", heading]
        for name, target in section.items():
            package, program = target.split()
            if not is_installed(package):
                continue
            lines.append(f"  {name:<{width}}  {summary(program, tables_of(package)[program])}".rstrip())
    lines += ["", "Examples:", *(f"  {example}" for example in _EXAMPLES)]
    lines += ["", "pendulum COMMAND --help has more of each. Completion with the Tab key, in bash or zsh:"]
    return "\n".join([*lines, "  source <(pendulum --completion bash)"])
