"""Emulated X5-9: physics, firmware, temperatures, faults, and its server process."""

from pendulum_msgs_py.plants.plant_parameters import SERIES_ELASTIC_PRESETS

__all__ = ["EMULATOR_PRESETS", "EMULATOR_PRESET_NAMES"]

EMULATOR_PRESETS = ("thesis", *SERIES_ELASTIC_PRESETS)
"""Plant presets of the emulator: the thesis's machine, and those with a drivetrain."""
EMULATOR_PRESET_NAMES = ", ".join(EMULATOR_PRESETS)
"""The same for help texts."""
