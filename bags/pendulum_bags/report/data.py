"""What a report is made from, and how it writes numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pendulum_bags.comparison import Comparison
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plant_parameters import PlantParameters, load_plant

if TYPE_CHECKING:
    from pendulum_bags.input_replay import InputReplay

__all__ = ["ReportData", "quantity", "ratio_in_words"]


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class ReportData:
    """Everything that figures and tables draw on.

    Args:
        comparison: The comparison.
        summary: Content of ``summary.json``.
        replays: Real recordings driven through our plant.
        names: Names of the run folders.
    """

    comparison: Comparison
    summary: Mapping[str, Any]
    replays: Sequence[InputReplay] = ()
    names: Sequence[str] = ()
    plant: PlantParameters | None = field(init=False)

    def __post_init__(self) -> None:
        """Find the plant that the run was designed on."""
        object.__setattr__(self, "plant", self._find_plant())

    @property
    def run(self) -> Mapping[str, Any]:
        """Return what the simulation's bag says about its run."""
        told = self.comparison.pairs[0].simulation.metadata.get("pendulum.run")
        return told if isinstance(told, Mapping) else {}

    def _find_plant(self) -> PlantParameters | None:
        name = self.run.get("plant", "thesis")
        try:
            return load_plant(str(name))
        except ParameterError:
            # The file that the run was made with is gone: figures of the model are left out, and say so.
            return None


def quantity(value: float, unit: str = "", digits: int = 3) -> str:
    """Return a number with its unit as text, with ``digits`` significant digits, powers of ten where needed."""
    if math.isnan(value):
        return "–"
    magnitude = abs(value)
    if magnitude != 0.0 and (magnitude < 1e-4 or magnitude >= 1e6):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = f"10{str(int(exponent)).translate(_SUPERSCRIPT)}"
        text = power if mantissa == "1" else f"{mantissa}×{power}"
    else:
        text = f"{value:.{digits}g}"
        if "e" in text:
            text = f"{value:.0f}"
    return f"{text.replace('-', '−')} {unit}".rstrip()


def ratio_in_words(ratio: float, larger: str = "larger", smaller: str = "smaller") -> str:
    """Return a ratio as a reader would say it, such as ``12 % smaller`` or ``2.2 times as large``."""
    if 0.995 <= ratio <= 1.005:
        return "equal within half a per cent"
    if ratio >= 1.75:
        return f"{ratio:.2g} times as {larger.removesuffix('r') if larger == 'larger' else larger}"
    if ratio > 1.0:
        return f"{100.0 * (ratio - 1.0):.2g} % {larger}"
    return f"{100.0 * (1.0 - ratio):.2g} % {smaller}"
