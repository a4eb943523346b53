"""Studies of many closed loops: a plant drawn from its uncertainty, held upright by its LQR, in reproducible chunks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.joint_run import design_for
from pendulum_bags.studies.uncertain import THESIS_UNCERTAINTY, Uncertainty
from pendulum_lqr.controller_interface.loop_check import settling_lqr
from pendulum_lqr.linear.design import Gain
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, is_mechanism, load_mechanism

__all__ = ["ClosedLoops", "Columns"]

_Loops = TypeVar("_Loops", bound="ClosedLoops")

Columns = dict[str, NDArray[Any]]
"""Columns of a table by name, shape (n,) each; SI units."""


@dataclass(frozen=True)
class ClosedLoops:
    """What to run. Defaults are those of a plant of one joint; :meth:`of` takes those of any plant.

    Attributes:
        plant: Preset or file of the nominal plant; the controller is designed on it.
        q: Diagonal of Q; plants of several joints have their own weights.
        duration: Of each run [s].
        dt: Period of the loop [s].
        device: Where the batches run, ``cpu`` or ``cuda``.
    """

    OF_SEVERAL: ClassVar[Mapping[str, Any]] = {}
    """Defaults of several joints that differ."""
    ONE_ONLY: ClassVar[frozenset[str]] = frozenset({"q", "r", "method"})
    """Settings that only plants of one joint have."""
    SEVERAL_ONLY: ClassVar[frozenset[str]] = frozenset()
    """Settings that only plants of several joints have."""
    NO_RESULT: ClassVar[frozenset[str]] = frozenset()
    """Settings that a chunk does not depend on."""

    plant: str = "thesis"
    uncertainty: Uncertainty = THESIS_UNCERTAINTY
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    method: str = "etd2"
    duration: float = 5.0
    dt: float = 0.002
    seed: int = 1
    device: str = "cpu"

    @classmethod
    def of(cls: type[_Loops], plant: str, **given: Any) -> _Loops:
        """Return the settings for a plant of any number of joints, with the defaults that it has."""
        several = {"uncertainty": Uncertainty(), "method": "auto", **cls.OF_SEVERAL} if is_mechanism(plant) else {}
        return cls(plant=plant, **{**several, **given})

    @cached_property
    def nominal(self) -> PlantParameters:
        """The nominal rigid plant; pickled with the settings, because a worker may not have its file."""
        plant = load_mechanism(self.plant)
        if plant.drivetrain is not None:
            raise ParameterError(
                f"plant {plant.name!r} is series elastic; expected a rigid one: the batch has no motor"
            )
        return plant

    @cached_property
    def gain(self) -> Gain:
        """The LQR that holds every plant, designed on the nominal one."""
        plant = self.nominal
        weights = (self.q, self.r) if plant.is_pendulum else plant.weights
        return settling_lqr(design_for(plant), *weights, self.dt)

    @property
    def steps(self) -> int:
        """Steps of each run."""
        return max(1, round(self.duration / self.dt))

    def generator(self, index: int) -> np.random.Generator:
        """Return what draws a chunk."""
        return np.random.Generator(np.random.Philox(key=[self.seed, index]))

    def content(self) -> dict[str, Any]:
        """Return the settings that this kind of plant has, for files."""
        found = asdict(self)
        one = self.nominal.is_pendulum
        if not one:
            found["shares"] = found.pop("uncertainty")["shares"]
        others = self.SEVERAL_ONLY if one else self.ONE_ONLY
        return {name: value for name, value in found.items() if name not in others}

    def fingerprint(self) -> str:
        """Return a hash of all that a chunk depends on; the device counts because a GPU rounds differently."""
        plant = self.nominal
        settings = {
            name: value
            for name, value in self.content().items()
            if name not in self.NO_RESULT and (name, value) != ("device", "cpu")
        }
        numbers: dict[str, Any] = {**plant.numbers}
        if plant.is_pendulum:
            numbers |= {"drivetrain": None, "name": plant.name}
        content = json.dumps([settings, numbers], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]
