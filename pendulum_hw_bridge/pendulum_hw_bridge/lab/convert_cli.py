"""``convert``: convert a HEBI log to a CSV file in joint coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pendulum_hw_bridge.backends.hebi_log import read_hebilog, to_joint
from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.lab_file import load_lab
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option

__all__ = ["main"]


def convert(
    log: Annotated[Path, typer.Argument(help="The .hebilog file.")],
    out: Annotated[Path | None, out_option("CSV file to write. Default: next to the log.")] = None,
    lab: Annotated[Path | None, typer.Option(help="Lab file, for zero, sign and tare of the joint.")] = None,
    module: Annotated[int | None, typer.Option(help="Which module of a log of several, from 0.", min=0)] = None,
) -> None:
    """Write what a HEBI log holds as CSV: time [s], then all quantities in SI units, joint coordinates.

    Example: python -m pendulum_hw_bridge convert hw.hebilog --lab lab.yaml
    """
    quantities = read_hebilog(log, module=module)
    if lab is not None:
        values = load_lab(lab).values
        quantities = to_joint(
            quantities,
            zero=values.get("joint_offset", 0.0),
            sign=values.get("joint_sign", 1),
            tare=values.get("effort_tare", 0.0),
        )
    # Omit quantities without values (a loop that was off, an older firmware).
    kept = {name: column for name, column in quantities.items() if np.all(np.isfinite(column))}
    for name in ("position", "velocity", "effort"):
        if name not in kept:
            raise ParameterError(f"{log}: {name} is not a number everywhere; expected a log of one running module")
    target = out or log.with_suffix(".csv")
    with writing(f"table {target}", ParameterError):
        table = np.column_stack(list(kept.values()))
        np.savetxt(target, table, delimiter=",", header=",".join(kept), comments="", fmt="%.9g")
    print(f"{target}: {len(kept['time'])} records, {kept['time'][-1]:.2f} s, {len(kept) - 1} quantities")


main = command_line(convert, "python -m pendulum_hw_bridge convert")
