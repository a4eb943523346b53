"""What the emulated hardware of a run was made of, as its bag tells."""

from __future__ import annotations

from pendulum_bags.figures.table import Table
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.tables import parameter_rows
from pendulum_bags.runs.run_data import OpenBag, RunData, is_emulated
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, read_plants
from pendulum_msgs_py.plants.plant_parameters import DRIVETRAIN_SPECS, PLANT_SPECS, PlantParameters

__all__ = ["emulator_table"]


def emulator_table(data: ReportData) -> Table | None:
    """Return the constants of the emulator of the first run; None where none was used, or its bag does not tell."""
    hardware = data.comparison.pairs[0].hardware
    plant = _emulated_plant(hardware, data.open_bag) if is_emulated(hardware) else None
    if plant is None:
        return None
    rows = [*parameter_rows(PLANT_SPECS, plant), *parameter_rows(DRIVETRAIN_SPECS, plant.drivetrain)]
    return Table(
        "Constants of the emulator",
        f"No machine was measured: these constants ({plant.name}) took the place of one, those of the link first, then "
        "those of motor, gears and spring. Noise, steps and timing of the feedback are those of the named version of "
        "pendulum_hw_bridge.",
        ("constant", "value", "unit", "meaning"),
        rows,
        "Provenance",
        folded=True,
    )


def _emulated_plant(run: RunData, open_bag: OpenBag) -> PlantParameters | None:
    """Return the plant with a drivetrain that a run's diagnostics tell of."""
    space = str(run_record(run.metadata).get("namespace", "")).rstrip("/") + "/"
    try:
        with open_bag(run.source) as bag:
            told = bag.messages(names.DIAGNOSTICS) if names.DIAGNOSTICS in bag.topics else []
        texts = (
            pair.value
            for stored in told
            for status in stored.message.status
            for pair in status.values
            if status.name.startswith(space) and pair.key == PLANT_PARAMETERS
        )
        plants = read_plants(next(texts, "[]"))
    # The page is made without this table, too.
    except (BagError, DataError, ParameterError):
        return None
    return next((plant for plant in plants if isinstance(plant, PlantParameters) and plant.drivetrain), None)
