"""What the columns of a recording are, guessed by their names and tested against the data.

A name proposes; the data decide. A velocity is one only if its integral follows the position; that test also gives
units, sign, and the columns of arrays without names. The equation of motion shows whether an angle is 0 hanging or
upright. What no test can show is assumed, and says so.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.column_names import (
    ANGLES,
    WORDS,
    Candidate,
    candidate_of,
    is_command,
    slides,
    tokens_of,
    words_of,
)
from pendulum_bags.recordings.columns import Columns
from pendulum_bags.recordings.mapping import Rules
from pendulum_bags.recordings.physics import (
    ALIKE,
    FASTEST,
    Balance,
    balance_of,
    derivative,
    moves,
    turn_of,
    units_by_slope,
)
from pendulum_bags.recordings.units import INPUTS, UNITS, known_unit, quantity_of
from pendulum_msgs_py.errors import DataError

__all__ = ["Guess", "guess_rules"]

_LEAST_MISFIT = 0.2
"""Share of the acceleration that radians leave unexplained where the angle is in degrees."""
_MOST_PAIRS = 24
_MOST_ROWS = 400_000
"""Rows that a guess is tested on."""
_EQUAL_STEPS = 0.05
"""Largest spread of the steps of a clock, by their median."""
_ASSUMED = "assumed, for the file does not say: small angles in degrees, and a place in m, move alike"
_ASSUMED_ANGLE = "that it is an angle, and no place, is assumed"
_ASSUMED_PLACE = "m: assumed, for the file does not say"


@dataclass(frozen=True)
class Guess:
    """One row of what was guessed: quantity (``position of elbow``), column, unit, and how it was found.

    ``assumed``: no test shows some of it.
    """

    quantity: str
    column: str
    unit: str
    how: str
    assumed: bool = False


@dataclass
class _Found:
    """A joint that was found."""

    name: str
    stem: str
    position: str
    sections: dict[str, dict[str, Any]] = field(default_factory=dict)
    rows: list[Guess] = field(default_factory=list)

    def of(self, quantity: str) -> str:
        return f"{quantity} of {self.name}" if self.name else quantity


def guess_rules(
    columns: Columns, *, period: float | None = None, only: Mapping[str, str] | None = None
) -> tuple[Rules, list[Guess]]:
    """Return the mapping of a recording, and how each of its entries was found.

    A long recording is guessed from the middle of it, if all that moves does so there.

    Args:
        columns: The recording.
        period: Sampling period, if the caller knows it [s].
        only: Role (``position``, ..., or ``states`` for the first two) -> column, topic or beginning of a path to take.

    Raises:
        DataError: No time, no position, or more than one way to read the file.
    """
    part = columns.stretch(_MOST_ROWS)
    if part is not columns:
        try:
            guesser = _Guesser(part, period, dict(only or {}))
            found = guesser.rules()
        except DataError:
            pass  # all rows may show what these do not
        else:
            if not guesser.moves_elsewhere(columns):
                return found
    return _Guesser(columns, period, dict(only or {})).rules()


class _Guesser:
    def __init__(self, columns: Columns, period: float | None, only: dict[str, str]) -> None:
        self.columns, self.only, self.period = columns, only, period
        self.guesses: list[Guess] = []
        self.candidates = [
            one
            for name, column in columns.columns.items()
            if (one := candidate_of(name, column.unit, self.only)) is not None
        ]

    def rules(self) -> tuple[Rules, list[Guess]]:
        time = self._time()
        joints = self._joints()
        for joint in joints:
            self._velocity(joint, alone=len(joints) == 1)
        self._name_joints(joints)
        self._drives(joints)
        for joint in joints:
            self._zero(joint, joints)
        further: dict[str, Any] = {}
        if self.columns.is_table and any(
            np.isnan(self.columns.values(str(section["column"]))).any()
            for joint in joints
            for section in joint.sections.values()
        ):
            further["drop_nan"] = True
        rules = Rules(
            time,
            {joint.name: joint.sections for joint in joints},
            "the guess from names and data",
            further,
            guessed=True,
        )
        return rules, [
            *self.guesses,
            *(replace(row, quantity=joint.of(row.quantity)) for joint in joints for row in joint.rows),
        ]

    def moves_elsewhere(self, whole: Columns) -> bool:
        """Return whether something that has one value here, and a role by its name, moves in another part."""
        still = (one.name for one in self.candidates if not moves(self.columns.values(one.name)))
        return any(moves(whole.values(name)) for name in still)

    # -- time ------------------------------------------------------------------------------------------------------

    def _time(self) -> dict[str, Any]:
        if self.period is not None:
            self.guesses.append(Guess("time", f"every {self.period:g} s", "s", "as given"))
            return {"period": self.period, "unit": "s"}
        states = [self.columns.columns[one.name] for one in self.candidates if one.role in {"position", "velocity"}]
        if states and all(column.clock for column in states):
            clocks = dict.fromkeys(column.clock for column in states)
            self.guesses.append(Guess("time", ", ".join(clocks), "s", "the stamps of each quantity"))
            return {"own": True}
        named = [one.name for one in self.candidates if one.role == "time"]
        # A plain name goes before one inside a path.
        named.sort(key=lambda name: (len(tokens_of(name)), name))
        names = [name for name in named if _increases(self.columns.values(name))]
        how = "by its name; it increases"
        if not names and not self.columns.named:
            names = [name for name in self.columns.columns if self._may_be_time(name)]
            how = "the only column that increases, and by unequal steps or fractions"
            if len(names) > 1:
                spreads = {name: _spread_of_steps(self.columns.values(name)) for name in names}
                first, second = sorted(spreads.values())[:2]
                if not (first < _EQUAL_STEPS and second > 10.0 * first):
                    raise self._ambiguous("time", names)
                names = [min(spreads, key=lambda name: spreads[name])]
                how = "of the columns that increase the one by steps ten times as equal as those of the others"
        if not names and self.columns.period is not None:
            self.guesses.append(Guess("time", f"every {self.columns.period:g} s", "s", "the file states it"))
            return {"period": self.columns.period, "unit": "s"}
        if not names:
            refused = f" ({', '.join(named)} does not increase)" if named else ""
            raise DataError(
                f"{self.columns.path} has no column of time{refused}; it has {self._listed()}: --dt SECONDS gives the "
                "time between two rows, --topic time=COLUMN names the column"
            )
        return self._time_section(names[0], how)

    def _time_section(self, name: str, how: str) -> dict[str, Any]:
        column = self.columns.columns[name]
        # Not the name of a struct: `s.t` says nothing of seconds.
        words = map(known_unit, tokens_of(re.split(r"[/.]", name)[-1]))
        stated = column.unit or next((word for word in words if word in UNITS["time"]), "")
        values = self.columns.values(name)
        step = float(np.median(np.diff(values[np.isfinite(values)])))
        unit = stated if stated in UNITS["time"] else _time_unit(step)
        assumed = not stated and unit != "s"
        note = f"; steps of {step:.4g} are taken for {unit}" if assumed else ""
        self.guesses.append(Guess("time", name, unit, how + note, assumed))
        return {"column": name, "unit": unit}

    def _may_be_time(self, name: str) -> bool:
        values = self.columns.values(name)
        steps = np.diff(values)
        is_index = bool(steps.size and np.all(steps == 1.0))
        return _increases(values) and not is_index

    # -- motion ----------------------------------------------------------------------------------------------------

    def _joints(self) -> list[_Found]:
        found = [one for one in self.candidates if one.role == "position"]
        if any(not one.weak for one in found):
            places = WORDS["place"]
            found = [one for one in found if not one.weak or set(one.label.casefold().split("_")) & places]
        still = ""
        chosen: dict[str, Candidate] = {}
        for one in sorted(found, key=lambda one: one.rank):
            values = self.columns.values(one.name)
            if one.stem in chosen:
                self.guesses.append(Guess("left out", one.name, "", f"{chosen[one.stem].name} has that name too"))
                continue
            if not moves(values):
                self.guesses.append(Guess("left out", one.name, "", "it has one value throughout"))
                still = one.name
                continue
            chosen[one.stem] = one
        if chosen:
            order = list(self.columns.columns)
            ordered = sorted(chosen.values(), key=lambda one: order.index(one.name))
            return [self._joint(one.label, one.stem, one.name, one.unit, one.how) for one in ordered]
        return self._joints_by_data(still)

    def _joint(self, label: str, stem: str, column: str, unit: str, how: str) -> _Found:
        joint = _Found(label, stem, column)
        joint.sections["position"] = {"column": column, "unit": unit}
        joint.rows.append(Guess("position", column, unit, how))
        return joint

    def _joints_by_data(self, still: str) -> list[_Found]:
        """Return the joints of columns without names: those of which another column is the derivative.

        ``still`` is a column with the name of a position, which has one value throughout; empty for none.
        """
        taken = {guess.column for guess in self.guesses}
        moving = [name for name in self.columns.columns if name not in taken and moves(self.columns.values(name))]
        # What increases may be a counter or another clock, but for unequal steps: those of a plant that turns one way.
        names = [name for name in moving if not _increases(self.columns.values(name))] or [
            name for name in moving if _spread_of_steps(self.columns.values(name)) > _EQUAL_STEPS
        ]
        pairs = []
        if len(names) <= _MOST_PAIRS:
            for one in names:
                for other in names:
                    time = self._stamps(one)
                    a, b = self.columns.values(one), self.columns.values(other)
                    if one == other or time is None or a.size != b.size or not np.isfinite(a + b).all():
                        continue
                    slope = derivative(time, a, b)
                    if slope.alike > 0.95 and units_by_slope(slope.slope, "", ""):
                        pairs.append((slope.alike, one, other))
        joints: list[_Found] = []
        used: set[str] = set()
        for alike, one, other in sorted(pairs, reverse=True):
            if not used & {one, other}:
                used |= {one, other}
                how = f"{other} is its derivative (correlation {alike:.3f})"
                joints.append(self._joint(one, one, one, "", how))
                self.candidates.append(Candidate(other, "velocity", one, 0, False, "", one))
        if joints:
            order = list(self.columns.columns)
            return sorted(joints, key=lambda joint: order.index(joint.position))
        if still:
            raise DataError(
                f"{self.columns.path}: the position {still} is {float(np.nanmean(self.columns.values(still))):.6g} "
                "throughout; expected a plant that moves, or --topic position=COLUMN with another column"
            )
        if len(names) == 1:
            return [self._joint("", "", names[0], "", "the only column that moves")]
        raise self._ambiguous("position", names)

    def _ambiguous(self, role: str, names: Sequence[str]) -> DataError:
        rows = []
        for name in self.columns.columns:
            values = self.columns.values(name)
            known = values[np.isfinite(values)]
            span = f"{known.min():.4g} to {known.max():.4g}" if known.size else "no number"
            rows.append(f"{name} ({span})")
        several = "none of its columns is plainly" if len(names) != 1 else "it is not plain that its columns hold"
        return DataError(
            f"{self.columns.path}: {several} the {role}; expected names such as time, position, velocity, torque, or "
            f"--topic {role}=COLUMN with one of {', '.join(rows)}"
        )

    def _stamps(self, column: str) -> Array | None:
        """Return the stamps of a column [s], all of them in order; None where they are not."""
        clock = self.columns.columns[column].clock
        guess = next(guess for guess in self.guesses if guess.quantity == "time")
        if self.period or (self.columns.period and guess.column not in self.columns.columns and not clock):
            period = float(self.period or self.columns.period or 0.0)
            return period * np.arange(self.columns.columns[column].size, dtype=np.float64)
        name = clock or guess.column
        size = UNITS["time"].get(self.columns.columns[name].unit or guess.unit, 1.0)
        stamps = self.columns.values(name) * size
        return stamps if np.all(np.diff(stamps[np.isfinite(stamps)]) >= 0.0) else None

    def _together(self, one: str, other: str) -> tuple[Array, Array, Array] | None:
        """Return stamps and values of two columns at those of the first; None where they share too little."""
        stamps, others = self._stamps(one), self._stamps(other)
        if stamps is None or others is None:
            return None
        a, b = self.columns.values(one), self.columns.values(other)
        if a.size != stamps.size or b.size != others.size:
            return None
        known, known_other = np.isfinite(a) & np.isfinite(stamps), np.isfinite(b) & np.isfinite(others)
        if min(known.sum(), known_other.sum()) < 20:
            return None
        time, a = stamps[known], a[known]
        first = np.append(True, np.diff(time) > 0.0)
        time, a = time[first], a[first]
        return time, a, np.interp(time, others[known_other], b[known_other])

    def _velocity(self, joint: _Found, *, alone: bool) -> None:
        """Take the velocity that the data confirm, and the units and sign that they give."""
        section = joint.sections["position"]
        how = joint.rows[0].how
        if not section["unit"] and slides(joint.position, alone=alone):
            section["unit"], how = "m", f"{how}; {_ASSUMED_PLACE}"
        tried: list[str] = []
        best: tuple[bool, float, Candidate, float, Array, Array] | None = None
        for one in (one for one in self.candidates if one.role == "velocity"):
            shared = self._together(joint.position, one.name)
            if shared is None:
                continue
            stamps, position, velocity = shared
            if turn := self._turn(joint.position):
                position = np.unwrap(position, period=turn)
            slope = derivative(stamps, position, velocity)
            own = alone or one.stem == joint.stem
            if abs(slope.alike) >= ALIKE:
                score = (own, abs(slope.alike) - 0.001 * one.rank)
                if best is None or score > best[:2]:
                    best = (*score, one, slope.slope, position, velocity)
            elif own:
                tried.append(f"{one.name} is not its derivative (correlation {slope.alike:.2f})")
        stated = bool(section["unit"]) or (best is not None and bool(best[2].unit))
        wanted, why = ("", "") if stated else self._angle_unit(joint.position, alone=alone)
        if best is not None:
            _, _, one, size, _, _ = best
            ways = units_by_slope(size, str(section["unit"]), one.unit)
            if not ways and stated:
                raise DataError(
                    f"{self.columns.path}: column {one.name!r} [{one.unit or 'unit not stated'}] is {size:.3g} times "
                    f"the derivative of {joint.position!r} [{section['unit'] or 'unit not stated'}]; expected the "
                    "derivative in the unit that the file states: correct the units in a mapping file"
                )
            if ways:
                # Both in degrees have the slope of both in radians.
                unit, speed, sign = next((way for way in ways if way[0] == wanted), ways[0])
                if unit != wanted and not stated:
                    why = "the only unit in which the velocity fits"
                section["unit"] = unit
                joint.sections["velocity"] = {"column": one.name, "unit": speed} | ({"sign": -1} if sign < 0 else {})
                words = f"tested: {size:.3g} times the derivative of the column of the position"
                words += ", of which it is therefore the negative" * (sign < 0)
                joint.rows.append(Guess("velocity", one.name, speed, words))
            else:
                tried.append(f"{one.name} is {size:.3g} times its derivative, which is no unit")
        section["unit"] = section["unit"] or wanted
        if why:
            how += f"; {section['unit']}: {why}"
        if why and section["unit"] == "deg" and "jumps" not in why and not set(words_of(joint.position)) & ANGLES:
            how += f"; {_ASSUMED_ANGLE}"
        turn = self._turn(joint.position)
        if turn:
            how += f"; it is wrapped (jumps of {turn:.4g}), and is unwrapped"
        how += "".join(f"; {text}, left out" for text in tried)
        joint.rows[0] = Guess(
            "position",
            joint.position,
            str(section["unit"]),
            how,
            any(one in how for one in (_ASSUMED, _ASSUMED_ANGLE, _ASSUMED_PLACE)),
        )

    def _turn(self, column: str) -> float:
        values = self.columns.values(column)
        turn = turn_of(values[np.isfinite(values)])
        return next((one for one in (2.0 * math.pi, 360.0, 1.0) if abs(turn / one - 1.0) < 0.1), 0.0)

    def _angle_unit(self, column: str, *, alone: bool) -> tuple[str, str]:
        """Return the unit of an angle (``alone``: of the only joint) and what shows it: jumps, speed or equation."""
        turn = self._turn(column)
        if turn:
            units = {"rad": 2.0 * math.pi, "deg": 360.0, "rev": 1.0}
            unit = min(units, key=lambda unit: abs(math.log(turn / units[unit])))
            return unit, f"by the jumps of {turn:.4g}"
        values, stamps = self.columns.values(column), self._stamps(column)
        if stamps is None or values.size != stamps.size:
            return "rad", _ASSUMED
        known = np.isfinite(values) & np.isfinite(stamps)
        time, values = stamps[known], values[known]
        first = np.append(True, np.diff(time) > 0.0)
        time, values = time[first], values[first]
        if time.size < 50:
            return "rad", _ASSUMED
        stride = max(1, round(0.1 / float(np.median(np.diff(time)))))
        speeds = np.abs(np.diff(values[::stride])) / np.diff(time[::stride])
        if speeds.size and float(speeds.max()) > FASTEST:
            return "deg", f"{float(speeds.max()):.3g} rad/s would be faster than any pendulum"
        if not alone:
            return "rad", _ASSUMED  # joints pull at each other, and periodic motions fit linear equations
        drives = [
            (own[has], drive[has])
            for one in self.candidates
            if one.role == "input" and moves(drive := self.columns.values(one.name))
            if (own := self._stamps(one.name)) is not None and own.size == drive.size
            for has in [np.isfinite(drive) & np.isfinite(own)]
        ]
        left = {}
        for unit in ("rad", "deg"):
            balance = balance_of(time, values * UNITS["angle"][unit], drives)
            left[unit] = 1.0 if balance is None else 1.0 - balance.explained
        unit, other = sorted(left, key=lambda one: left[one])
        # A line fits small degrees as it fits a spring: degrees are found where radians fail.
        if left[unit] < 0.5 and left[unit] < 0.25 * left[other] and (unit == "rad" or left[other] > _LEAST_MISFIT):
            shares = f"{1.0 - left[unit]:.0%} of its acceleration against {1.0 - left[other]:.0%} in {other}"
            return unit, f"tested: gravity and input explain {shares}"
        return "rad", _ASSUMED

    # -- drives ----------------------------------------------------------------------------------------------------

    def _drives(self, joints: Sequence[_Found]) -> None:
        for role in ("input", "reference", "disturbance"):
            found = [one for one in self.candidates if one.role == role]
            moving = [
                one
                for one in found
                if one.chosen or moves(self.columns.values(one.name)) or self._steps_in(one, joints)
            ]
            for one in found:
                if one not in moving and role != "input":
                    self.guesses.append(Guess("left out", one.name, "", "it has one value throughout"))
            if role == "input" and any(not one.weak for one in moving):
                moving = [one for one in moving if not one.weak]
            moving.sort(key=lambda one: one.rank)
            free = list(joints)
            for one in moving:
                joint = next((joint for joint in free if joint.stem and joint.stem == one.stem), None)
                if joint is not None:
                    free.remove(joint)
                    self._drive(joint, role, one, one.how)
            stems = {joint.stem for joint in joints if joint.stem}
            rest = [one for one in moving if one.stem not in stems or len(joints) == 1]
            taken = {str(joint.sections[role]["column"]) for joint in joints if role in joint.sections}
            rest = [one for one in rest if one.name not in taken]
            if rest and free and not taken:
                # A motor moves the cart or the arm, which come first.
                sliding = [joint for joint in free if joint.sections["position"]["unit"] in UNITS["place"]]
                joint = (sliding or free)[0]
                others = ", ".join(one.name for one in rest[1:])
                how = rest[0].how + (f", for {joint.name}" if len(joints) > 1 else "")
                how += f"; not taken: {others}" * bool(others)
                self._drive(joint, role, rest[0], how)

    def _drive(self, joint: _Found, role: str, one: Candidate, how: str) -> None:
        unit, assumed = one.unit, False
        position = str(joint.sections["position"]["unit"])
        if role == "reference":
            if not unit or quantity_of(unit) != quantity_of(position):
                unit, assumed = position, True
        elif quantity_of(unit) not in INPUTS or quantity_of(unit) == "angle":
            unit, assumed = "-", True
        elif unit == "N m" and not self.columns.columns[one.name].unit and "effort" in one.name.casefold():
            how, assumed = f"{how}; an effort is taken for a torque", True
        if position in UNITS["place"] and unit == "N m":
            unit = "N"
        section: dict[str, Any] = {"column": one.name, "unit": unit}
        if role == "input":
            known = one.rank == 0 and "applied" not in one.name.casefold()
            measured = unit in {"N m", "N"} and (known or (one.rank == 1 and not is_command(one.name)))
            section["hold"] = "linear" if measured and not self._is_apart(one.name, joint.position) else "zero"
            how += f"; taken as {'a measurement' if section['hold'] == 'linear' else 'a command'}"
        if assumed and "taken for" not in how:
            how += "; its unit is not stated"
        joint.sections[role] = section
        joint.rows.append(Guess(role, one.name, unit, how, assumed))

    def _steps_in(self, one: Candidate, joints: Sequence[_Found]) -> bool:
        """Return whether a column of one value begins after the motion, so that it is a step from 0."""
        stamps, motion = self._stamps(one.name), self._stamps(joints[0].position)
        values = self.columns.values(one.name)
        if one.role != "input" or stamps is None or motion is None or stamps.size != values.size:
            return False
        known = np.isfinite(values) & np.isfinite(stamps)
        apart = self._is_apart(one.name, joints[0].position)
        return bool(known.any() and apart and values[known][0] != 0.0 and stamps[known][0] > np.nanmin(motion))

    def _is_apart(self, one: str, other: str) -> bool:
        """Return whether two columns have values at other times."""
        if self.columns.columns[one].clock != self.columns.columns[other].clock:
            return True
        a, b = self.columns.values(one), self.columns.values(other)
        if a.size != b.size:
            return True
        both, least = np.sum(np.isfinite(a) & np.isfinite(b)), min(np.sum(np.isfinite(a)), np.sum(np.isfinite(b)))
        return bool(2 * both < least)

    # -- zero ------------------------------------------------------------------------------------------------------

    def _zero(self, joint: _Found, joints: Sequence[_Found]) -> None:
        """Give an angle that is 0 upright the offset by which it is 0 hanging, where the motion shows it."""
        section = joint.sections["position"]
        unit = str(section["unit"])
        if unit in UNITS["place"]:
            return
        balance = self._balance(joint, joints)
        row = joint.rows[0]
        assumed = row.assumed
        alone = "" if any("input" in one.sections for one in joints) else ", if nothing drives it"
        if balance is None or not balance.hangs_at:
            words, assumed = "that 0 hangs down is assumed", True
        elif balance.hangs_at == "0":
            words = f"tested: 0 hangs down (t = {balance.t:.0f}){alone}"
        else:
            section["offset"] = round(math.pi / UNITS["angle"][unit], 9)
            followed = joint.sections.get("reference", {})
            if quantity_of(str(followed.get("unit"))) == "angle":
                followed["offset"] = round(math.pi / UNITS["angle"][str(followed["unit"])], 9)
            words = f"tested: 0 is upright (t = {balance.t:.0f}){alone}, so that {section['offset']:.6g} is added"
        joint.rows[0] = Guess(row.quantity, row.column, row.unit, f"{row.how}; {words}", assumed or bool(alone))

    def _balance(self, joint: _Found, joints: Sequence[_Found]) -> Balance | None:
        alone = self._angle(joint, None)
        if alone is None or alone[0].size < 50:
            return None
        time, angle = alone
        drives = []
        for one in joints:
            if "input" not in one.sections:
                continue
            column = str(one.sections["input"]["column"])
            stamps, values = self._stamps(column), self.columns.values(column)
            if stamps is None or stamps.size != values.size:
                return None
            has = np.isfinite(values) & np.isfinite(stamps)
            drives.append((stamps[has], values[has]))
        if not drives and (np.ptp(angle) < 1.0 or any("reference" in one.sections for one in joints)):
            return None  # a controller whose commands are not here may hold it anywhere
        others = [found[1] for one in joints if one is not joint and (found := self._angle(one, time)) is not None]
        return balance_of(time, angle, drives, others)

    def _angle(self, joint: _Found, at: Array | None) -> tuple[Array, Array] | None:
        """Return stamps and position of a joint in SI, unwrapped, at some times; None where it has none in order."""
        unit = str(joint.sections["position"]["unit"])
        stamps, values = self._stamps(joint.position), self.columns.values(joint.position)
        if stamps is None or values.size != stamps.size:
            return None
        known = np.isfinite(values) & np.isfinite(stamps)
        time, position = stamps[known], values[known] * UNITS[quantity_of(unit)][unit]
        first = np.append(True, np.diff(time) > 0.0)
        time, position = time[first], position[first]
        if unit in UNITS["angle"]:
            position = np.unwrap(position)
        return (time, position) if at is None else (at, np.interp(at, time, position))

    def _name_joints(self, joints: Sequence[_Found]) -> None:
        """Give joints names that differ; a plant of one needs none."""
        if len(joints) == 1:
            joints[0].name = ""
        labels = [joint.name or f"joint{index}" for index, joint in enumerate(joints)]
        for index, joint in enumerate(joints):
            if len(joints) > 1:
                joint.name = labels[index] if labels.count(labels[index]) == 1 else f"{labels[index]}_{index}"

    def _listed(self) -> str:
        return ", ".join(self.columns.columns)


def _increases(values: Array) -> bool:
    """Return whether stamps go on, but for a clock that stepped back a few times."""
    known = values[np.isfinite(values)]
    if known.size < 3 or known[-1] == known[0]:
        return False
    steps = np.diff(known)
    return bool(np.mean(steps >= 0.0) > 0.99 and np.mean(steps > 0.0) > 0.5)


def _spread_of_steps(values: Array) -> float:
    """Return the range of the middle nine tenths of the steps of a column, by their median."""
    low, middle, high = np.quantile(np.diff(values[np.isfinite(values)]), (0.05, 0.5, 0.95))
    return float((high - low) / max(abs(middle), 1e-300))


def _time_unit(step: float) -> str:
    """Return the unit in which a step is the period of a recording: 0.1 ms to a second."""
    for unit in ("s", "ms", "us", "ns"):
        if step * UNITS["time"][unit] < 1.0:
            return unit
    return "s"
