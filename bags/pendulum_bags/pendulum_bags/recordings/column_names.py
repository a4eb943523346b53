"""What the name of a column proposes: its words, its role, the joint that it names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pendulum_bags.recordings.units import INPUTS, UNITS, quantity_of

__all__ = ["ANGLES", "WORDS", "Candidate", "candidate_of", "is_command", "is_of", "slides", "tokens_of", "words_of"]

WORDS: Mapping[str, frozenset[str]] = {
    "time": frozenset({"t", "time", "times", "timestamp", "timestamps", "stamp", "tout", "elapsed", "zeit", "sec"}),
    "velocity": frozenset({"vel", "velocity", "speed", "omega", "dot", "qd", "dq", "angvel", "geschwindigkeit"}),
    "angle": frozenset(
        {"theta", "th", "angle", "angles", "alpha", "phi", "psi", "beta", "pos", "position", "q", "qpos", "winkel",
         "angular", "encoder", "y"}
    ),
    "place": frozenset({"x", "cart", "distance", "place", "slider"}),
    "input": frozenset(
        {"u", "torque", "tau", "effort", "voltage", "volt", "volts", "pwm", "input", "command", "cmd", "action", "duty",
         "vm", "current", "control", "motor", "force", "actuator", "moment"}
    ),
    "reference": frozenset({"ref", "reference", "target", "desired", "des", "setpoint", "goal", "sp", "soll"}),
    "disturbance": frozenset({"disturbance", "dist", "perturbation", "pert", "noise"}),
}  # fmt: skip
_NEVER = frozenset(
    {"raw", "err", "error", "squared", "cos", "sin", "latency", "index", "frame", "fric", "friction", "acc", "accel",
     "acceleration", "ddot", "tf", "rotation", "translation", "quaternion", "orientation", "layout", "parameter",
     "events", "imu", "temp", "temperature", "saturation", "feedforward", "offset", "episode", "reward", "done", "id",
     "count", "covariance", "delta", "frequency", "log"}
)  # fmt: skip
_WEAK = frozenset({"y", "q", "x", "th", "control", "motor", "current", "encoder", "angular", "action", "force", "cart"})
"""Words that mean something else where a plainer one is there."""
ANGLES = WORDS["angle"] - _WEAK - {"pos", "position", "qpos"}
"""Words that only an angle has."""
_NAMING = frozenset({"theta", "alpha", "phi", "psi", "beta", "x", "cart", "distance", "angle", "slider"})
"""Words that are the name of a joint, too."""
_MEASURED, _FILTERED = (
    frozenset({"meas", "measured", "actual", "applied"}),
    frozenset({"filt", "filtered", "est", "estimated"}),
)
_COMMANDED = frozenset({"con", "cmd", "command", "commanded", "controller", "u"})
_PLAIN = frozenset(
    {"joint", "joints", "states", "state", "observation", "values", "value", "signals", "data", "sim", "hw"}
)
_UNIT_WORDS = {
    "deg": "deg", "degrees": "deg", "rad": "rad", "ms": "ms", "us": "us", "ns": "ns", "rpm": "rpm", "nm": "N m",
    "volt": "V", "volts": "V", "voltage": "V", "v": "V", "vm": "V", "torque": "N m", "tau": "N m", "effort": "N m",
    "moment": "N m", "pwm": "-", "duty": "-",
}  # fmt: skip
_TOKENS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]+")
_STATES = ("position", "velocity")
_WORD_OF = {"position": "angle"}


@dataclass
class Candidate:
    """A column with the role that its name proposes."""

    name: str
    role: str
    stem: str
    rank: int
    weak: bool
    unit: str
    label: str
    chosen: bool = False

    @property
    def how(self) -> str:
        """How its role was found."""
        return "as given" if self.chosen else "by its name"


def is_of(column: str, place: str) -> bool:
    """Return whether a column is one of a given name, or of a topic or path of that name."""
    return column == place or column.startswith((f"{place}/", f"{place}.", f"{place}["))


def candidate_of(name: str, stated: str, only: Mapping[str, str]) -> Candidate | None:
    """Return a column with the role that its name and its stated unit propose, or None.

    ``only`` are roles whose columns the caller has chosen, as of :func:`guess_rules`.
    """
    wanted = next((role for role, start in only.items() if is_of(name, start)), "")
    words = tokens_of(name)
    present = {word.casefold() for word in words}
    if wanted == "" and present & _NEVER:
        return None
    role = _role(words, present, stated) if wanted in {"", "states"} else wanted
    weak = not (present - _WEAK) & WORDS.get(_WORD_OF.get(role, role), frozenset())
    if weak and not wanted and re.search(r"\[\d+\]$", name):
        return None  # rows of an array such as x or y are states, of which the data say more
    if not role or (not wanted and _is_taken(role, only)) or (wanted == "states" and role not in _STATES):
        return None
    stem = "_".join(word for word in words if _names_joint(word.casefold()))
    measured, filtered = bool(present & _MEASURED), bool(present & _FILTERED)
    rank = 0 if measured else 2 if filtered else 3 if role == "input" and present & {"con", "commanded"} else 1
    unit = stated or next((_UNIT_WORDS[word.casefold()] for word in words if word.casefold() in _UNIT_WORDS), "")
    if role == "velocity" and not stated and unit in UNITS["angle"]:
        unit += "/s"  # as of omega_rad_s
    return Candidate(name, role, stem.casefold(), rank, weak and not wanted, unit, _label(name, stem), bool(wanted))


def _is_taken(role: str, only: Mapping[str, str]) -> bool:
    """Return whether the caller chose another column for a role."""
    return role in only or (role in _STATES and "states" in only)


def _role(words: Sequence[str], present: set[str], stated: str) -> str:
    """Return the role that the words of a name and a stated unit propose; empty for none."""
    quantity = quantity_of(stated)
    if words and words[-1].casefold() in WORDS["time"] and len(words) > 1:
        return "time"
    if quantity in {"velocity", "speed"}:
        return "velocity"
    has = {role for role, known in WORDS.items() if present & known}
    if "disturbance" in has:
        return "disturbance"
    if "velocity" in has or _is_derivative(words):
        return "" if "reference" in has else "velocity"
    if "reference" in has:
        return "reference"
    if quantity == "time" or ("time" in has and not has - {"time"}):
        return "time"
    if quantity in INPUTS and quantity != "angle":
        return "input"
    if quantity in {"angle", "place"}:
        return "input" if "input" in has - {"angle"} and not has & {"angle", "place"} else "position"
    if "Q" in words and not present & {"theta", "angle", "position"}:
        return "input"
    if has & {"angle", "place"} and not (present & {"effort", "torque", "tau"}):
        return "position"
    return "input" if "input" in has else "time" if "time" in has else ""


def _names_joint(word: str) -> bool:
    """Return whether a word of a name is the name of a joint."""
    known = set().union(*WORDS.values()) | _MEASURED | _FILTERED | _COMMANDED | _PLAIN | {"d", "dot"}
    return word in _NAMING or (word not in known and word not in _UNIT_WORDS)


def tokens_of(name: str) -> list[str]:
    """Return the words of a name: parts of paths, of camel case, and numbers."""
    found: list[str] = []
    for word in _TOKENS.findall(re.sub(r"[\[(][^\[\]()]*[A-Za-z°][^\[\]()]*[\])]", " ", name)):
        low = word.casefold()
        for ending in ("dot", "velocity", "vel"):
            if low.endswith(ending) and low != ending and not low.startswith("d"):
                found += [word[: -len(ending)], ending]
                break
        else:
            if low[:1] == "d" and low[1:] in {"theta", "alpha", "phi", "th", "q", "x", "angle", "beta"}:
                found += [word[1:], "dot"]
            else:
                found.append(word)
    return found


def words_of(name: str) -> set[str]:
    """Return them in small letters."""
    return {word.casefold() for word in tokens_of(name)}


def _is_derivative(words: Sequence[str]) -> bool:
    """Return whether a capital or a separate d marks the derivative of an angle: ``angleD``, ``d_theta``."""
    angles = WORDS["angle"] | WORDS["place"]
    folded = [word.casefold() for word in words]
    beside = [
        (folded[index - 1 : index], folded[index + 1 : index + 2]) for index, one in enumerate(folded) if one == "d"
    ]
    return any(angles & {*before, *behind} for before, behind in beside)


def slides(name: str, *, alone: bool) -> bool:
    """Return whether a name is that of a place; an x alone may be an angle."""
    words = words_of(name)
    return bool(words & (WORDS["place"] - ({"x"} if alone else set()))) and not words & ANGLES


def is_command(name: str) -> bool:
    """Return whether a name is that of a command, not of a measurement."""
    return bool(words_of(name) & {"con", "cmd", "command", "u", "control", "action"})


def _label(name: str, stem: str) -> str:
    """Return a name of a joint that a reader recognises."""
    parts = [part for part in re.split(r"[/.]", name) if part]
    if len(parts) > 1 and parts[-1].casefold() in {"position", "pos", "angle", "q"}:
        return parts[-2]
    return f"joint{stem}" if stem.isdecimal() else stem or name
