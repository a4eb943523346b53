"""The source text of a MuJoCo model (MJCF or URDF), with the numbers in it by name.

A parameter is where a number stands in the text, so that a changed model is the file with other characters there: the
same order, comments and whitespace. Its name is ``kind/name/attribute`` or ``kind/name/attribute/component``:

* ``joint/arm/damping``, ``frictionloss``, ``armature``, ``stiffness``;
* ``body/link/mass``;
* ``body/link/inertia``, all components in their ratio, or ``inertia/x``, ``y``, ``z`` (the diagonal, in the frame in
  which the file has it);
* ``body/link/ipos``, the distance of the centre of mass from the body's frame along its direction, or ``ipos/x`` ...;
* ``actuator/motor/gear`` (the first component, or ``gear/2`` ...), ``kp``, ``kv``; ``geom/rod/mass``;
  ``tendon/rope/stiffness``, and any other attribute with numbers that the element states itself.

A joint without a name has that of its body, an actuator without one that of its joint.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from pendulum_msgs_py.atomic_write import write_atomically
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.foreign.mujoco_model import import_mujoco, read_model

__all__ = ["WRITTEN", "ModelParameter", "ModelSource"]

WRITTEN = "Identified by output error"
"""How the comment on top of a written file begins."""

_ATTRIBUTE = re.compile(rb"""\s([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')""")
_NUMBER = re.compile(rb"\S+")
_AXES = {"x": 0, "y": 1, "z": 2}
_ACTUATORS = "actuator"
_TENDONS = "tendon"
_OF_JOINT = {"damping": "N m s/rad", "frictionloss": "N m", "armature": "kg m^2", "stiffness": "N m/rad"}
_OF_SLIDE = {"damping": "N s/m", "frictionloss": "N", "armature": "kg", "stiffness": "N/m"}
_IN_URDF = {"damping": "damping", "frictionloss": "friction"}
"""Attributes of a joint's ``dynamics`` in URDF."""
_FILES = re.compile(rb"""(?:file|meshdir|texturedir|assetdir|filename)\s*=\s*["'](?!/|package://)[^"']""")
_DIGITS = 9
"""Significant digits of a written number."""


@dataclass
class _Element:
    """One element: where its start tag and its attributes' values stand in the bytes of its document."""

    document: int
    tag: str
    start: int
    parent: _Element | None
    names: dict[str, str]
    children: list[_Element] = field(default_factory=list)
    new: bool = False

    def walk(self) -> Iterator[_Element]:
        yield self
        for child in self.children:
            yield from child.walk()

    def child(self, tag: str) -> _Element | None:
        return next((one for one in self.children if one.tag == tag), None)


@dataclass(frozen=True)
class _Slot:
    """One number: component of an attribute of an element; it is ``ratio`` times the parameter."""

    element: int
    attribute: str
    component: int
    ratio: float = 1.0


@dataclass(frozen=True)
class ModelParameter:
    """One number of a model file.

    Attributes:
        name: Path, as in :mod:`pendulum_sim.foreign.model_source`.
        value: As the file has it.
        unit: Its unit; empty if unknown.
        positive: Whether it cannot be 0 or less.
        signed: Whether it may be below 0.
        joint: Index in the model of the joint that it is of; -1 without one.
        place: Where a new number is put, in words; empty where one stands already.
        slots: What is written.
    """

    name: str
    value: float
    unit: str
    positive: bool = False
    signed: bool = False
    joint: int = -1
    place: str = ""
    slots: tuple[_Slot, ...] = ()


class ModelSource:
    """A model file as text; see the module.

    Raises:
        ParameterError: MuJoCo is missing, or refuses the file.
    """

    def __init__(self, path: str | Path) -> None:
        self.mujoco = import_mujoco()
        self.path = Path(path).expanduser()
        self.model, self.remarks = read_model(self.mujoco, self.path)
        self._names = [self.path.name]
        self._texts = [self.path.read_bytes()]
        self._elements: list[_Element] = []
        self._values: dict[tuple[int, str], list[float]] = {}
        self._root = self._parse(0)
        self._included(self._root)

    @property
    def is_urdf(self) -> bool:
        """Whether it is a description of ROS."""
        return self._root.tag == "robot"

    def rollout(self, threads: int) -> Any:
        """Return MuJoCo's runner of many motions at a time, on some threads."""
        from mujoco import rollout

        return rollout.Rollout(nthread=threads if threads > 1 else 0)

    # --- parameters ---------------------------------------------------------------------------------------------

    def parameter(self, name: str) -> ModelParameter:
        """Return the parameter of a name.

        Raises:
            ParameterError: There is no such element or number.
        """
        kind, _, rest = name.partition("/")
        parts = rest.rsplit("/", 2)
        component = ""
        if len(parts) > 1 and (parts[-1] in _AXES or parts[-1].isdigit()):
            component = parts.pop()
        if kind not in {"joint", "body", "geom", _ACTUATORS, _TENDONS} or len(parts) < 2:
            raise ParameterError(
                f"parameter is {name!r}; expected KIND/NAME/ATTRIBUTE, such as joint/arm/damping or body/link/mass; "
                "kinds are joint, body, geom, actuator and tendon"
            )
        owner, attribute = "/".join(parts[:-1]), parts[-1]
        if kind == "body":
            return self._of_body(name, owner, attribute, component)
        element = self._find(kind, owner, name)
        if kind == "joint":
            return self._of_joint(name, element, owner, attribute, component)
        value = None if kind != _ACTUATORS or attribute != "gear" else self._gear(owner)
        return self._of_attribute(name, element, attribute, component, "", value)

    def candidates(self, joints: Sequence[int]) -> list[ModelParameter]:
        """Return what is usually unknown of the joints of these indices and of the bodies that they move."""
        model, found = self.model, list[ModelParameter]()
        named = {int(index): name for name, index in self._indices("joint").items()}
        for joint in joints:
            for one in ("damping", "frictionloss", "armature") if joint in named else ():
                with suppress(ParameterError):  # URDF has no armature, and no element states a replicated joint
                    found.append(self.parameter(f"joint/{named[joint]}/{one}"))
        moved = {int(model.jnt_bodyid[joint]) for joint in joints}
        for body in range(1, model.nbody):
            above, name = body, str(model.body(body).name)
            while above and above not in moved:
                above = int(model.body_parentid[above])
            if not above or not name or not model.body_mass[body] > 0.0:
                continue
            for one in ("inertia", "ipos", "mass"):
                with suppress(ParameterError):  # its centre of mass is at its frame, or links were fused
                    found.append(self.parameter(f"body/{name}/{one}"))
        return found

    def _of_joint(self, name: str, element: _Element, owner: str, attribute: str, component: str) -> ModelParameter:
        index = self._indices("joint")[owner]
        slides = int(self.model.jnt_type[index]) == int(self.mujoco.mjtJoint.mjJNT_SLIDE)
        unit = (_OF_SLIDE if slides else _OF_JOINT).get(attribute, "")
        if not unit or component:
            return replace(self._of_attribute(name, element, attribute, component, unit, None), joint=index)
        field_name = "jnt_stiffness" if attribute == "stiffness" else f"dof_{attribute}"
        values = getattr(self.model, field_name)
        value = float(values[index if attribute == "stiffness" else self.model.jnt_dofadr[index]])
        if self.is_urdf:
            if attribute not in _IN_URDF:
                raise ParameterError(f"parameter is {name!r}, which URDF does not have; expected an MJCF file for it")
            element = element.child("dynamics") or self._add(element, "dynamics", {})
            attribute = _IN_URDF[attribute]
        return replace(self._of_attribute(name, element, attribute, "", unit, value), joint=index)

    def _of_body(self, name: str, owner: str, attribute: str, component: str) -> ModelParameter:
        element = self._find("body", owner, name)
        if attribute not in {"mass", "inertia", "ipos"} or (component and component not in _AXES):
            raise ParameterError(
                f"parameter is {name!r}; expected mass, inertia or ipos of a body, the last two with /x, /y, /z or none"
            )
        inertial, place = element.child("inertial"), ""
        if inertial is None:
            if self.is_urdf:
                raise ParameterError(
                    f"link {owner!r} of {self.path} has no inertial element; expected one with its mass"
                )
            inertial = self._add_inertial(element, owner)
        if inertial.new:
            place = (
                f"an inertial element in body {owner}, which had mass and inertia from its geoms: they count no more"
            )
        unit, positive = {"mass": ("kg", True), "inertia": ("kg m^2", True), "ipos": ("m", False)}[attribute]
        if self.is_urdf:
            tag, attributes = {
                "mass": ("mass", ("value",)),
                "inertia": ("inertia", ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")),
                "ipos": ("origin", ("xyz",)),
            }[attribute]
            holder = inertial.child(tag)
            if holder is None:
                raise ParameterError(f"link {owner!r} of {self.path} has no {tag}; expected one, for {name}")
            keys = [(self._key(holder), one, i) for one in attributes for i in range(3 if one == "xyz" else 1)]
        else:
            full = "fullinertia" in inertial.names
            one, count = {
                "mass": ("mass", 1), "inertia": ("fullinertia" if full else "diaginertia", 6 if full else 3),
                "ipos": ("pos", 3),
            }[attribute]  # fmt: skip
            keys = [(self._key(inertial), one, i) for i in range(count)]
        numbers = [self._number(*key, name) for key in keys]
        if component or attribute == "mass":
            at = _AXES.get(component, 0)
            slots: tuple[_Slot, ...] = (_Slot(*keys[at]),)
            value = numbers[at]
        else:
            value = float(np.linalg.norm(numbers)) if attribute == "ipos" else max(numbers[:3])
            if value == 0.0:
                raise ParameterError(
                    f"{name} is 0 in {self.path}, along no direction; expected a component, as {name}/z"
                )
            slots = tuple(_Slot(*key, number / value) for key, number in zip(keys, numbers, strict=True) if number)
        return ModelParameter(
            name, value, unit, positive=positive or (attribute == "ipos" and not component),
            signed=bool(component) and attribute == "ipos", place=place, slots=slots,
        )  # fmt: skip

    def _of_attribute(
        self, name: str, element: _Element, attribute: str, component: str, unit: str, value: float | None
    ) -> ModelParameter:
        at = _AXES.get(component, int(component) - 1 if component.isdigit() else 0)
        key, place = self._key(element), ""
        if attribute not in element.names:
            if value is None or at:
                has = ", ".join(sorted({*element.names, *(_OF_JOINT if element.tag == "joint" else ())} - {"name"}))
                raise ParameterError(
                    f"{name}: the element of {self.path} does not state {attribute}; expected one of these: {has}"
                )
            self._values.setdefault((key, attribute), [value])
            place = f"attribute {attribute} of {element.tag} {name.split('/')[1]} itself, which had it from a default"
        else:
            value = self._number(key, attribute, at, name)
        return ModelParameter(
            name, value, unit or {"mass": "kg", "gear": "-"}.get(attribute, ""),
            positive=attribute in {"mass", "density", "gear", "kp"} and value > 0.0,
            signed=not unit and attribute not in {"mass", "density", "kp", "kv"}, place=place,
            slots=(_Slot(key, attribute, at),),
        )  # fmt: skip

    def _gear(self, owner: str) -> float | None:
        index = self._indices(_ACTUATORS).get(owner)
        return None if index is None else float(self.model.actuator_gear[self.model.actuator_outadr[index], 0])

    def _number(self, key: int, attribute: str, component: int, name: str) -> float:
        numbers = self._numbers(key, attribute)
        if component >= len(numbers):
            raise ParameterError(
                f"{name}: {attribute} has {len(numbers)} numbers in {self.path}; expected a component of it"
            )
        return numbers[component]

    def _numbers(self, key: int, attribute: str) -> list[float]:
        if (key, attribute) not in self._values:
            text = self._elements[key].names.get(attribute, "0")
            try:
                self._values[key, attribute] = [float(one) for one in text.split()]
            except ValueError as error:
                raise ParameterError(f"{attribute} is {text!r} in {self.path}; expected numbers") from error
        return self._values[key, attribute]

    # --- elements -----------------------------------------------------------------------------------------------

    def _indices(self, kind: str) -> dict[str, int]:
        """Return the elements of the compiled model by name; one without a name has that of its body or joint."""
        model, found = self.model, dict[str, int]()
        counts = {"joint": model.njnt, _ACTUATORS: model.nactuator}
        for index in range(counts[kind]):
            name = str(getattr(model, kind)(index).name)
            if not name and kind == "joint":
                name = str(model.body(model.jnt_bodyid[index]).name)
            elif not name and model.actuator_trntype[index] == int(self.mujoco.mjtTrn.mjTRN_JOINT):
                name = str(model.joint(model.actuator_trnid[index, 0]).name)
            if name:
                found.setdefault(name, index)
        return found

    def _find(self, kind: str, owner: str, name: str) -> _Element:
        tags = {"joint": ("joint",), "body": ("link",) if self.is_urdf else ("body",), "geom": ("geom",)}
        found: dict[str, _Element] = {}
        for element in self._root.walk():
            parent = element.parent
            while parent is not None and parent.tag == "frame":
                parent = parent.parent
            if parent is None:
                continue
            if kind in tags:
                if element.tag not in tags[kind] or parent.tag in {
                    "default",
                    _ACTUATORS,
                    "equality",
                    "fixed",
                    "transmission",
                    "gazebo",
                }:
                    continue
                other = parent.names.get("name", "")
            else:
                if parent.tag != kind:
                    continue
                other = element.names.get("joint", "")
            found.setdefault(element.names.get("name") or other, element)
        chosen = found.get(owner)
        known = set(found)
        if kind in {"joint", "body"}:
            compiled = {str(getattr(self.model, kind)(i).name) for i in range(getattr(self.model, f"n{_SHORT[kind]}"))}
            known &= {*compiled, *(self._indices("joint") if kind == "joint" else ())}
        if chosen is None or owner not in known:
            listed = ", ".join(sorted(one for one in known & set(found) if one and one != "world")) or "none"
            raise ParameterError(f"{name}: {self.path} states no {kind} {owner!r}; expected one of: {listed}")
        return chosen

    def _key(self, element: _Element) -> int:
        return next(i for i, one in enumerate(self._elements) if one is element)

    def _add(self, parent: _Element, tag: str, names: dict[str, str]) -> _Element:
        element = _Element(parent.document, tag, -1, parent, names, new=True)
        parent.children.append(element)
        self._elements.append(element)
        return element

    def _add_inertial(self, body: _Element, owner: str) -> _Element:
        index = self.model.body(owner).id
        values = {
            "pos": self.model.body_ipos[index], "quat": self.model.body_iquat[index],
            "mass": self.model.body_mass[[index]], "diaginertia": self.model.body_inertia[index],
        }  # fmt: skip
        return self._add(body, "inertial", {one: " ".join(map(_text, numbers)) for one, numbers in values.items()})

    def _parse(self, document: int) -> _Element:
        parser, stack, roots = expat.ParserCreate(), list[_Element](), list[_Element]()

        def begin(tag: str, names: dict[str, str]) -> None:
            parent = stack[-1] if stack else None
            element = _Element(document, tag, parser.CurrentByteIndex, parent, names)
            (roots if parent is None else parent.children).append(element)
            self._elements.append(element)
            stack.append(element)

        parser.StartElementHandler = begin
        parser.EndElementHandler = lambda _: stack.pop()
        try:
            parser.Parse(self._texts[document], True)
        except expat.ExpatError as error:
            raise ParameterError(f"{self.path} cannot be read as XML: {error}") from error
        return roots[0]

    def _included(self, element: _Element) -> None:
        """Read the files that an element includes, as its children."""
        for child in list(element.children):
            if child.tag == "include" and "file" in child.names:
                name = child.names["file"]
                try:
                    self._texts.append((self.path.parent / name).read_bytes())
                except OSError as error:
                    raise ParameterError(f"{self.path} includes {name}, which cannot be read: {error}") from error
                self._names.append(name)
                root = self._parse(len(self._texts) - 1)
                self._included(root)
                # What is included counts where the include stands.
                for one in root.children:
                    one.parent = element
                element.children += root.children
            else:
                self._included(child)

    # --- another model ------------------------------------------------------------------------------------------

    def compile(self, parameters: Sequence[ModelParameter], values: Sequence[float]) -> Any:
        """Return the model with other values of some parameters.

        Raises:
            ParameterError: MuJoCo refuses it.
        """
        texts = self.texts(parameters, values)
        included = dict(zip(self._names[1:], texts[1:], strict=True))
        return read_model(self.mujoco, self.path, texts[0].decode("utf-8", errors="replace"), included)[0]

    def texts(self, parameters: Sequence[ModelParameter], values: Sequence[float]) -> list[bytes]:
        """Return the documents with other values of some parameters: the file, then those that it includes."""
        changed: dict[int, dict[str, dict[int, float]]] = {}
        for parameter, value in zip(parameters, values, strict=True):
            for slot in parameter.slots:
                changed.setdefault(slot.element, {}).setdefault(slot.attribute, {})[slot.component] = value * slot.ratio
        edits: list[tuple[int, int, int, bytes]] = []
        for key, attributes in changed.items():
            edits += self._edits(self._elements[key], attributes)
        texts = list(self._texts)
        for document, start, stop, text in sorted(edits, reverse=True):
            texts[document] = texts[document][:start] + text + texts[document][stop:]
        return texts

    def _edits(
        self, element: _Element, attributes: Mapping[str, Mapping[int, float]]
    ) -> Iterator[tuple[int, int, int, bytes]]:
        if element.new:
            assert element.parent is not None
            names = dict(element.names)
            for attribute, numbers in attributes.items():
                tokens = names.get(attribute, "0").split()
                for at, number in numbers.items():
                    tokens[at] = _text(number)
                names[attribute] = " ".join(tokens)
            written = " ".join(f'{one}="{text}"' for one, text in names.items())
            first, last = self._tag(element.parent)
            text = self._texts[element.document]
            indent = re.match(rb"\s*", text[last:])
            assert indent is not None
            yield element.document, last, last, indent.group() + f"<{element.tag} {written}/>".encode()
            return
        first, last = self._tag(element)
        tag = self._texts[element.document][first:last]
        spans = {one.group(1).decode(): one.span(2) for one in _ATTRIBUTE.finditer(tag)}
        for attribute, numbers in attributes.items():
            if attribute not in spans:
                end = max((stop for _, stop in spans.values()), default=1 + len(element.tag))
                yield element.document, first + end, first + end, f' {attribute}="{_text(numbers[0])}"'.encode()
                continue
            start, stop = spans[attribute]
            places = [one.span() for one in _NUMBER.finditer(tag, start + 1, stop - 1)]
            for at, number in numbers.items():
                begin, end = places[at]
                yield element.document, first + begin, first + end, _text(number).encode()

    def _tag(self, element: _Element) -> tuple[int, int]:
        """Return where the start tag of an element begins, and one past where it ends."""
        text, quote, at = self._texts[element.document], 0, element.start
        while quote or text[at] != ord(">"):
            if text[at] in b"\"'" and quote in {0, text[at]}:
                quote = 0 if quote else text[at]
            at += 1
        return element.start, at + 1

    def check_target(self, out: Path) -> None:
        """Raise a ParameterError if the file cannot be written back under a name."""
        if out.suffix != self.path.suffix:
            raise ParameterError(f"--out is {out.name!r}; expected a name that ends in {self.path.suffix}")
        if out.exists() and out.samefile(self.path):
            raise ParameterError(f"--out is {out}, the model itself; expected another file")
        if out.exists() and WRITTEN.encode() not in out.read_bytes():
            raise ParameterError(f"--out is {out}, a file that identify has not written; expected another name")
        if out.resolve().parent != self.path.resolve().parent and any(_FILES.search(text) for text in self._texts):
            raise ParameterError(
                f"{self.path} names other files by their place; expected --out in its folder, "
                f"{self.path.resolve().parent}"
            )

    def write(
        self, out: Path, parameters: Sequence[ModelParameter], values: Sequence[float], remarks: Sequence[str]
    ) -> list[Path]:
        """Write the file with other values, ``remarks`` in a comment before its root, and read the numbers back.

        A file that it includes is written too, with the name of ``out`` before its own, if a number stands in it.

        Raises:
            ParameterError: As :meth:`check_target`, or MuJoCo refuses it, or reads other numbers.
        """
        self.check_target(out)
        texts, written = self.texts(parameters, values), [out]
        for i, name in enumerate(self._names[1:], start=1):
            if texts[i] == self._texts[i]:
                continue
            other = Path(name).with_name(f"{out.stem}_{Path(name).name}")
            pattern = re.compile(rb"""(<include\s[^>]*file\s*=\s*["'])""" + re.escape(name.encode()) + rb"""(?=["'])""")
            texts = [pattern.sub(rb"\g<1>" + str(other).encode(), text) for text in texts]
            written.append(out.parent / other)
        comment = "\n     ".join(remarks).replace("--", "- -").rstrip("-").encode()
        head, end = self._root.start, b"\r\n" if b"\r\n" in texts[0] else b"\n"
        texts[0] = texts[0][:head] + (b"<!-- " + comment + b" -->\n").replace(b"\n", end) + texts[0][head:]
        changed = [text for text, old in zip(texts, self._texts, strict=True) if text != old]
        for path, text in zip(written[1:] + written[:1], changed[1:] + changed[:1], strict=True):
            write_atomically(path, text)
        again = ModelSource(out)
        for parameter, value in zip(parameters, values, strict=True):
            read = again.parameter(parameter.name).value
            if not np.isclose(read, value, rtol=1e-6, atol=1e-12):
                raise ParameterError(f"{parameter.name} is {read:g} in {out} as read back; expected {value:g}")
        return written


_SHORT = {"joint": "jnt", "body": "body"}


def _text(number: float) -> str:
    return f"{number:.{_DIGITS}g}"
