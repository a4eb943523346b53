"""PID gains of the three firmware loops, with the X5-9's defaults and HEBI's gains file.

The file is the XML of HEBI Scope and hebi-py (``group_gains``), so a real module and the emulator share one file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from xml.etree import ElementTree

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import read_text, reject_unknown

__all__ = [
    "DEFAULT_GAINS",
    "GAIN_FIELDS",
    "LOOPS",
    "GainSet",
    "PidGains",
    "differing_gain",
    "limit_output",
    "load_gains",
    "write_gains",
]

LOOPS = ("position", "velocity", "effort")
"""Loops of the firmware, in its order."""


@dataclass(frozen=True)
class PidGains:
    """One PID loop of the firmware.

    Attributes:
        kp: Proportional gain [output / input].
        ki: Integral gain [output / (input s)].
        kd: Derivative gain [output s / input].
        feed_forward: Share of the (normalised) setpoint added to the output [-].
        dead_zone: Error that counts as none [input].
        i_clamp: Largest integral term [output].
        punch: Added to the output in the direction of the error, outside the dead zone [output].
        min_target: Lower clamp of the setpoint [input].
        max_target: Upper clamp [input].
        target_lowpass: Weight of the new setpoint in each cycle; 1 is no filter [-].
        min_output: Lower clamp of the output.
        max_output: Upper clamp.
        output_lowpass: Weight of the new output in each cycle; 1 is no filter [-].
        d_on_error: Differentiate the error (1) or the measurement alone (0).
    """

    kp: float = 0.0
    ki: float = 0.0
    kd: float = 0.0
    feed_forward: float = 0.0
    dead_zone: float = 0.0
    i_clamp: float = 0.0
    punch: float = 0.0
    min_target: float = -math.inf
    max_target: float = math.inf
    target_lowpass: float = 1.0
    min_output: float = -1.0
    max_output: float = 1.0
    output_lowpass: float = 1.0
    d_on_error: float = 1.0

    def __post_init__(self) -> None:
        """Refuse invalid gains, which the firmware would accept silently."""
        for item in fields(self):
            value = getattr(self, item.name)
            infinite_allowed = item.name in {"min_target", "max_target"}
            if math.isnan(value) or (math.isinf(value) and not infinite_allowed):
                raise ParameterError(f"gain {item.name} is {value}; expected a finite number")
        for name in ("kp", "ki", "kd", "dead_zone", "i_clamp", "punch"):
            if getattr(self, name) < 0.0:
                raise ParameterError(f"gain {name} is {getattr(self, name)}; expected >= 0")
        for name in ("target_lowpass", "output_lowpass"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ParameterError(f"gain {name} is {getattr(self, name)}; expected > 0 and <= 1")
        for kind in ("target", "output"):
            low, high = getattr(self, f"min_{kind}"), getattr(self, f"max_{kind}")
            if not low < high:
                raise ParameterError(f"gain min_{kind} is {low} and max_{kind} {high}; expected min < max")
        if self.d_on_error not in {0.0, 1.0}:
            raise ParameterError(f"gain d_on_error is {self.d_on_error}; expected 0 or 1")


@dataclass(frozen=True)
class GainSet:
    """Gains of the three loops, and the strategy that they are for (1 to 4)."""

    strategy: int
    position: PidGains
    velocity: PidGains
    effort: PidGains

    def loop(self, name: str) -> PidGains:
        """Return the gains of a loop by name."""
        if name not in LOOPS:
            raise ParameterError(f"loop is {name!r}; expected one of {', '.join(LOOPS)}")
        gains: PidGains = getattr(self, name)
        return gains


_EFFORT = PidGains(kp=0.25, kd=0.001, feed_forward=1.0, min_target=-20.0, max_target=20.0, output_lowpass=0.9)
_TORQUE_OUTPUT = {"min_output": -20.0, "max_output": 20.0}
_VELOCITY = PidGains(kp=0.05, feed_forward=1.0, output_lowpass=0.75)

DEFAULT_GAINS: Mapping[int, GainSet] = {
    1: GainSet(1, PidGains(), PidGains(), PidGains(feed_forward=1.0)),
    2: GainSet(
        2, PidGains(kp=15.0, **_TORQUE_OUTPUT), PidGains(kp=0.5, output_lowpass=0.75, **_TORQUE_OUTPUT), _EFFORT
    ),
    3: GainSet(3, PidGains(kp=1.5), _VELOCITY, _EFFORT),
    4: GainSet(4, PidGains(kp=15.0, **_TORQUE_OUTPUT), _VELOCITY, _EFFORT),
}
"""Default gains of the X5-9 by strategy. Source: HEBI, "Default gains", X5-9."""

GAIN_FIELDS = tuple(item.name for item in fields(PidGains))
"""Names of a loop's gains, in order; also the element names of HEBI's file."""


def limit_output(gains: PidGains, output: float) -> PidGains:
    """Return the gains of a loop with its output clamped to +-``output``, or to its tighter clamps."""
    return replace(gains, min_output=max(gains.min_output, -output), max_output=min(gains.max_output, output))


def differing_gain(reads: GainSet, wanted: GainSet) -> str:
    """Return a sentence on the first gain that reads back differently, or an empty string.

    Infinite clamps are not written and not compared; the module stores single precision.
    """
    for loop in LOOPS:
        for name in GAIN_FIELDS:
            seen, asked = getattr(reads.loop(loop), name), getattr(wanted.loop(loop), name)
            if math.isfinite(asked) and not math.isclose(seen, asked, rel_tol=1e-5, abs_tol=1e-7):
                return f"{loop} gain {name} reads back as {seen:g}; expected {asked:g}"
    return ""


def load_gains(path: str | Path) -> GainSet:
    """Return the gains in a HEBI gains file; missing gains have the default of its strategy.

    Raises:
        ParameterError: No such file, not XML, an unknown element, or a refused value; names file and gain.
    """
    text = read_text(path, "gains file")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ParameterError(f"gains file {path} declares a document type; expected plain XML")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two: an encoding of its own
        raise ParameterError(f"gains file {path} is not XML: {error}") from error
    if root.tag != "group_gains":
        raise ParameterError(f"gains file {path}: root element is <{root.tag}>; expected <group_gains>")
    elements = {child.tag: child for child in root}
    reject_unknown(dict.fromkeys(elements), ("control_strategy", *LOOPS), where=str(path))
    number = _number(elements["control_strategy"], path) if "control_strategy" in elements else 3.0
    if number not in DEFAULT_GAINS:
        raise ParameterError(f"gains file {path}: control_strategy is {number:g}; expected 1 to 4")
    strategy = int(number)
    loops = {loop: DEFAULT_GAINS[strategy].loop(loop) for loop in LOOPS}
    for loop in LOOPS:
        if loop not in elements:
            continue
        given = {child.tag: _number(child, path) for child in elements[loop]}
        reject_unknown(given, GAIN_FIELDS, where=f"{path}: {loop}")
        try:
            loops[loop] = replace(loops[loop], **given)
        except ParameterError as error:
            raise ParameterError(f"gains file {path}: {loop}: {error}") from error
    return GainSet(strategy, **loops)


def write_gains(path: str | Path, gains: GainSet) -> Path:
    """Write a HEBI gains file that :func:`load_gains` reads back; ParameterError if it cannot be written."""
    root = ElementTree.Element("group_gains")
    ElementTree.SubElement(root, "control_strategy").text = str(gains.strategy)
    for loop in LOOPS:
        element = ElementTree.SubElement(root, loop)
        for name in GAIN_FIELDS:
            value = getattr(gains.loop(loop), name)
            # hebi-py parses a switch as an integer and refuses 1.0. Infinite clamps are written, because a missing one
            # would read as the strategy's default.
            text = str(int(value)) if name == "d_on_error" else repr(float(value))
            ElementTree.SubElement(element, name).text = text
    ElementTree.indent(root)
    path = Path(path)
    with writing(f"gains file {path}", ParameterError):
        write_atomically(path, '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n")
    return path


def _number(element: ElementTree.Element, path: str | Path) -> float:
    text = (element.text or "").strip()
    try:
        # A group file lists one value per module; ours has one module.
        return float(text)
    except ValueError as error:
        raise ParameterError(f"gains file {path}: {element.tag} is {text!r}; expected one number") from error
