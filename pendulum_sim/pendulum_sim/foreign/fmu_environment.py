"""A functional mock-up unit (FMI 2 or 3, co-simulation) as an environment, of which a Gymnasium plant is made.

A mapping file names what the unit does not declare; all entries but the format are optional::

    format: pendulum_simulation/1
    angle: {variable: theta, unit: rad, sign: 1, zero: 0.0}  # by default the output in rad, or of such a name
    velocity: {variable: theta_dot, unit: rad/s}             # that in rad/s
    torque: {variable: tau, sign: 1}                         # its only input
    start: [theta_0, theta_dot_0]                            # parameters, or variables with a start value
    values: {damping: 0.1}                                   # start values in place of the unit's own
    period: {value: 0.002, unit: s}
    effort_limit: {value: 2.0, unit: N m}                    # by default the bounds of the input
    equation: plant.yaml                                     # plant file; by default it is identified
"""

from __future__ import annotations

import atexit
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.parameters import load_yaml, reject_unknown, require_mapping
from pendulum_msgs_py.programs.extras import how_to_install
from pendulum_sim.foreign.gymnasium_plant import GymnasiumPlant
from pendulum_sim.foreign.mujoco_mapping import FORMAT

__all__ = ["FmuEnvironment", "load_fmu_mapping", "load_fmu_plant"]

_PERIOD = 0.002
"""Default time between two communication points [s]."""
_KEYS = ("angle", "velocity", "torque", "start", "values", "period", "effort_limit", "equation")
_ENTRIES = {
    "angle": ("variable", "unit", "sign", "zero"),
    "velocity": ("variable", "unit", "sign"),
    "torque": ("variable", "scale", "sign"),
}
_NAMES = {
    "angle": ("angle", "theta", "phi", "position", "q"),
    "velocity": ("velocity", "speed", "theta_dot", "thetadot", "dtheta", "omega", "w", "qd", "dq"),
}
_UNITS = {"angle": ("rad", "deg"), "velocity": ("rad/s", "deg/s")}
_STARTS = ("{}_0", "{}0", "{}_start", "start_{}", "initial_{}")
_DIGITS = 9
"""Decimals of a communication point [s]: a truncated one may lie before the last."""


def load_fmu_mapping(path: str | Path) -> dict[str, Any]:
    """Return the content of a mapping file; a ParameterError names file and entry."""
    document = load_yaml(path, "mapping file")
    if document.pop("format", None) != FORMAT:
        raise ParameterError(f"{path}: format is missing or another; expected {FORMAT!r}")
    reject_unknown(document, _KEYS, where=str(path))
    for name, allowed in _ENTRIES.items():
        if name in document:
            reject_unknown(require_mapping(document[name], f"{path}: {name}"), allowed, where=f"{path}: {name}")
    for name, value in require_mapping(document.get("values", {}), f"{path}: values").items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ParameterError(f"{path}: values: {name} is {value!r}; expected a number")
    return document


def load_fmu_plant(
    path: str | Path, mapping: Mapping[str, Any] | None = None, *, effort_limit: float = 0.0
) -> GymnasiumPlant:
    """Return the plant of a unit with one joint.

    Raises:
        ParameterError: FMPy is missing, or unit and mapping do not fit.
    """
    entries = dict(mapping or {})
    environment = FmuEnvironment(path, entries)
    adapter: dict[str, Any] = {
        "angle": {**entries.get("angle", {}), "index": 0},
        "velocity": {**entries.get("velocity", {}), "index": 1},
        "torque": {**entries.get("torque", {}), "index": 0},
        "start": {"options": "state"},
        "period": "dt",
    }
    for name in ("angle", "velocity", "torque"):
        adapter[name].pop("variable", None)
    if "effort_limit" in entries:
        adapter["effort_limit"] = entries["effort_limit"]
    if "equation" in entries:
        adapter["equation"] = entries["equation"]
    plant = GymnasiumPlant(environment, Path(path).name, adapter, 0, effort_limit)
    plant.description = environment.description
    plant.remarks = [*plant.remarks, environment.remark]
    return plant


class FmuEnvironment:
    """A unit, stepped as an environment is: one input, angle and velocity as observation.

    Args:
        path: The ``.fmu``.
        mapping: Entries of a mapping file.

    Attributes:
        dt: Time between two communication points [s].
        parameters: Start values of its parameters, by name.
    """

    def __init__(self, path: str | Path, mapping: Mapping[str, Any]) -> None:
        # Imported late: only units need FMPy, which takes a second.
        try:
            import fmpy
        except ImportError as error:
            raise ParameterError(how_to_install(error) or f"FMPy cannot be imported: {error}") from error
        self.path = Path(path).expanduser()
        if not self.path.is_file():
            raise ParameterError(f"model {self.path} does not exist; expected an FMU of FMI 2 or 3")
        try:
            self._description = fmpy.read_model_description(str(self.path), validate=False)
        except Exception as error:
            raise ParameterError(f"FMPy refuses model {self.path}: {' '.join(str(error).split())}") from error
        description = self._description
        if description.coSimulation is None:
            raise ParameterError(f"model {self.path} is for model exchange; expected one for co-simulation")
        self._third = description.fmiVersion.startswith("3")
        if not self._third and not description.fmiVersion.startswith("2"):
            raise ParameterError(f"model {self.path} is of FMI {description.fmiVersion}; expected FMI 2 or 3")
        self.description = f"fmi {description.fmiVersion}, fmpy {fmpy.__version__}"
        self._fmpy = fmpy
        self._variables = {
            one.name: one for one in description.modelVariables if one.type in {"Real", "Float64"}
            and not getattr(one, "dimensions", None)
        }  # fmt: skip
        self._input = self._choose_input(mapping.get("torque", {}).get("variable"))
        self._outputs = [self._choose(name, mapping.get(name, {}).get("variable")) for name in ("angle", "velocity")]
        self._starts = self._choose_starts(mapping.get("start"))
        self.parameters = {
            name: float(one.start) for name, one in self._variables.items()
            if one.causality == "parameter" and one.start is not None and name not in self._starts
        }  # fmt: skip
        self.values: dict[str, float] = {}
        for name, value in mapping.get("values", {}).items():
            if name not in self._variables or self._variables[name].start is None:
                raise self._error(f"it has no start value {name!r}; expected one of: {', '.join(self.parameters)}")
            self.values[name] = float(value)
        self.dt = self._choose_period(mapping.get("period"))
        bound = self._variables[self._input]
        low, high = (float(end) if end is not None else math.inf for end in (bound.min, bound.max))
        self.action_space = SimpleNamespace(
            shape=(1,), dtype=np.float64, low=np.array([-abs(low)]), high=np.array([abs(high)])
        )
        self.remark = (
            f"input {self._input}, outputs {self._outputs[0]} and {self._outputs[1]}, started by "
            f"{self._starts[0]} and {self._starts[1]}"
        )
        self._folder = fmpy.extract(str(self.path))
        atexit.register(shutil.rmtree, self._folder, ignore_errors=True)
        self._unit: Any = None
        self._steps = 0

    @property
    def unwrapped(self) -> FmuEnvironment:
        """Itself."""
        return self

    def reset(self, *, seed: int = 0, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new instance, at ``options["state"]`` if given: angle and velocity in the unit's terms."""
        self.close()
        try:
            self._unit = unit = self._fmpy.instantiate_fmu(self._folder, self._description, "CoSimulation")
            if not self._third:
                unit.setupExperiment(startTime=0.0)
            # Starts are set before initialization: that is when what depends on them is worked out.
            values = {**self.values, **dict(zip(self._starts, (options or {}).get("state", ()), strict=False))}
            for name, value in values.items():
                self._set(name, float(value))
            unit.enterInitializationMode()
            unit.exitInitializationMode()
        except Exception as error:
            raise FaultError(f"it does not start: {' '.join(str(error).split())}") from error
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance to the next communication point under an input, held until then."""
        self._set(self._input, float(action[0]))
        now, then = (round((self._steps + i) * self.dt, _DIGITS) for i in range(2))
        ended = False
        if self._third:
            # A unit that returns early is asked for the rest.
            step = self.dt
            while step > 0.0 and not ended:
                _, ended, early, reached = self._unit.doStep(currentCommunicationPoint=now, communicationStepSize=step)
                if early and reached <= now:
                    raise FaultError(f"it stays at {now:g} s; expected a step of {self.dt:g} s")
                now, step = reached, round(then - reached, _DIGITS) if early else 0.0
        else:
            self._unit.doStep(currentCommunicationPoint=now, communicationStepSize=self.dt)
        self._steps += 1
        return self._observe(), 0.0, bool(ended), False, {}

    def close(self) -> None:
        """End the instance."""
        if self._unit is not None:
            unit, self._unit = self._unit, None
            unit.terminate()
            unit.freeInstance()

    def _observe(self) -> Any:
        references = [self._variables[name].valueReference for name in self._outputs]
        return np.array((self._unit.getFloat64 if self._third else self._unit.getReal)(references), dtype=float)

    def _set(self, name: str, value: float) -> None:
        put = self._unit.setFloat64 if self._third else self._unit.setReal
        put([self._variables[name].valueReference], [value])

    # --- what is what -------------------------------------------------------------------------------------------

    def _error(self, text: str) -> ParameterError:
        return ParameterError(f"model {self.path}: {text}")

    def _named(self, name: str, kind: str) -> str:
        if name not in self._variables:
            raise self._error(f"it has no number {name!r} for {kind}; expected one of: {', '.join(self._variables)}")
        return name

    def _choose_input(self, wanted: str | None) -> str:
        if wanted is not None:
            return self._named(wanted, "torque")
        found = [name for name, one in self._variables.items() if one.causality == "input"]
        if len(found) != 1:
            listed = ", ".join(found) or "none"
            raise self._error(f"it has {len(found)} inputs ({listed}); expected one, or torque: {{variable: NAME}}")
        return found[0]

    def _choose(self, kind: str, wanted: str | None) -> str:
        if wanted is not None:
            return self._named(wanted, kind)
        outputs = {name: one for name, one in self._variables.items() if one.causality == "output"}
        found = [name for name, one in outputs.items() if one.unit in _UNITS[kind]]
        if len(found) != 1:
            found = [name for name in outputs if name.rpartition(".")[2].casefold() in _NAMES[kind]]
        if len(found) != 1:
            raise self._error(
                f"which of its outputs ({', '.join(outputs) or 'none'}) is the {kind} is open; expected one in "
                f"{_UNITS[kind][0]}, or {kind}: {{variable: NAME}} in a mapping file"
            )
        return found[0]

    def _choose_starts(self, wanted: Sequence[str] | None) -> tuple[str, str]:
        if wanted is not None:
            if not isinstance(wanted, list) or len(wanted) != 2:
                raise self._error(f"start is {wanted!r}; expected two names, [ANGLE, VELOCITY]")
            return self._named(str(wanted[0]), "the start"), self._named(str(wanted[1]), "the start")
        found = []
        for name in self._outputs:
            names = [form.format(name) for form in _STARTS]
            if self._variables[name].start is not None:
                names.append(name)
            if not (known := [one for one in names if one in self._variables]):
                raise self._error(
                    f"nothing sets its {name} at the start; expected a start value of it, a parameter such as "
                    f"{name}_0, or start: [ANGLE, VELOCITY] in a mapping file"
                )
            found.append(known[0])
        return found[0], found[1]

    def _choose_period(self, entry: object) -> float:
        if entry is not None:
            given = require_mapping(entry, f"model {self.path}: period")
            if given.get("unit") != "s" or not isinstance(given.get("value"), int | float) or not given["value"] > 0.0:
                raise self._error(f"period is {entry!r}; expected {{value: SECONDS, unit: s}}")
            return round(float(given["value"]), _DIGITS)
        fixed = getattr(self._description.coSimulation, "fixedInternalStepSize", None)
        step = float(fixed) if fixed else _PERIOD
        return round(max(1, math.floor(_PERIOD / step + 1e-9)) * step, _DIGITS)
