"""``export``: write a bag as Parquet or CSV files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.programs.executables import cli_main
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.tables import export_bag

__all__ = ["main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m pendulum_rosbag export runs/today/sim -o today_sim --format csv")
def export(
    bag: Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap or .db3 file.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to create.")],
    topics: Annotated[list[str] | None, typer.Option("-t", "--topic", help="Topic to export; by default all.")] = None,
    format: Annotated[str, typer.Option(help="parquet or csv.")] = "parquet",
) -> int:
    """Write each topic of a bag to a table of its own (SI units, times in nanoseconds)."""
    for path in export_bag(read_bag(bag, topics), output, format):
        print(path)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command."""
    return cli_main(app, argv, name="python -m pendulum_rosbag export")


if __name__ == "__main__":
    raise SystemExit(main())
