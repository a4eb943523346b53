"""Parameters of one kind of node: a row per parameter, a column per plant, differences marked."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui

from pendulum_console.console.graph import Description, Graph
from pendulum_msgs_py.errors import FaultError, PendulumError

__all__ = ["ParameterTable", "parse_value", "show_value"]

_HIDDEN = frozenset({"start_type_description_service", "use_sim_time", "autostart", "autoactivate", "command_type"})
"""Parameters that do not concern the running experiment."""
_ALL = "all plants"
_SMALLEST, _LARGEST = -(2**63), 2**63 - 1
"""Range of ROS's integer parameters."""
_UNIT = re.compile(r"\[[^]]+\]$")


def show_value(value: Any) -> str:
    """Return a value in its input format: ``0.1``, ``100, 0.01``, ``true``."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(show_value(item) for item in value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def parse_value(text: str, like: Any) -> Any:
    """Return the input as the type of the present value; a FaultError if it is not one."""
    text = text.strip()
    try:
        if isinstance(like, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(like, (list, tuple)):
            kind = like[0] if like else 0.0
            return [parse_value(part, kind) for part in text.split(",")]
        if isinstance(like, int) and not _SMALLEST <= int(text) <= _LARGEST:
            raise FaultError(f"{text} is too large; expected a whole number from {_SMALLEST} to {_LARGEST}")
        return type(like)(text) if isinstance(like, (int, float)) else text
    except (KeyError, ValueError):
        kinds = {bool: "true or false", int: "a whole number", float: "a number"}
        kind = kinds.get(type(like), "a value")
        raise FaultError(f"{text!r} is not {kind}; expected one like {show_value(like)}") from None


class ParameterTable:
    """The table for one kind of node, such as ``controller``; ``carefully`` awaits work and shows its errors."""

    def __init__(self, graph: Graph, kind: str, carefully: Callable[[Awaitable[Any]], Awaitable[bool]]) -> None:
        self._graph = graph
        self._kind = kind
        self._carefully = carefully
        self._fields: dict[tuple[str, str], ui.input] = {}
        self._marks: dict[str, ui.element] = {}
        self._shown: dict[tuple[str, str], Any] = {}
        self._drawn: Any = None

    def build(self) -> None:
        """Build the table's element."""
        self._place = ui.element("div").classes("parameters")

    async def refresh(self, spaces: Sequence[str]) -> None:
        """Show the present values, whichever client set them; redraw when nodes appear or vanish."""
        known = {space: values for space in spaces if (values := self._graph.parameters.get(f"{space}/{self._kind}"))}
        drawn = {space: sorted(values) for space, values in known.items()}
        if drawn != self._drawn:
            try:
                descriptions = {space: await self._graph.describe(f"{space}/{self._kind}") for space in known}
            except PendulumError:
                return  # it vanished meanwhile; the next poll retries
            self._drawn = drawn
            self._draw(known, descriptions)
        for (space, name), field in self._fields.items():
            value = known.get(space, {}).get(name)
            if value is not None and self._shown.get((space, name)) != value:
                self._shown[space, name] = value
                field.value = show_value(value)
        for name, mark in self._marks.items():
            in_force = {show_value(values[name]) for values in known.values() if name in values}
            mark.set_visibility(len(in_force) > 1)

    def _draw(self, known: dict[str, dict[str, Any]], descriptions: dict[str, dict[str, Description]]) -> None:
        self._place.clear()
        self._fields.clear()
        self._marks.clear()
        self._shown.clear()
        names = list(dict.fromkeys(name for values in known.values() for name in values if name not in _HIDDEN))
        with self._place:
            if not known:
                ui.label(f"No {self._kind} in this ROS domain yet.").classes("small")
                return
            with ui.element("table"):
                with ui.element("thead"), ui.element("tr"):
                    for title in ("parameter", *known, *([_ALL] if len(known) > 1 else [])):
                        with ui.element("th").props('scope="col"'):
                            ui.label(title)
                with ui.element("tbody"):
                    for name in names:
                        self._row(name, known, descriptions)

    def _row(
        self, name: str, known: dict[str, dict[str, Any]], descriptions: dict[str, dict[str, Description]]
    ) -> None:
        description = next(found[name] for found in descriptions.values() if name in found)
        with ui.element("tr"):
            with ui.element("th").props('scope="row"'):
                unit = _UNIT.search(description.text)
                with ui.label(f"{name} {unit.group() if unit else ''}").classes("name"):
                    ui.tooltip(description.text)
            for space, values in known.items():
                with ui.element("td"):
                    if name not in values:
                        ui.label("–").props('aria-label="has none"')
                    elif description.read_only:
                        ui.label(show_value(values[name]))
                    else:
                        self._field(name, space, description)
            if len(known) > 1:
                with ui.element("td"):
                    if not description.read_only:
                        self._field(name, _ALL, description, list(known))
                    self._marks[name] = ui.label("≠ differ").classes("differ")
                    self._marks[name].set_visibility(False)

    def _field(self, name: str, space: str, description: Description, spaces: Sequence[str] = ()) -> None:
        label = f"{name} of {space}"
        field = ui.input().props(f'dense outlined aria-label="{label}" data-name="{name}" data-plant-field="{space}"')
        if description.domain:
            field.tooltip(description.domain)

        async def take() -> None:
            for where in spaces or [space]:
                await self._set(where, name, str(field.value or ""))
            if spaces:
                field.value = ""

        field.on("change", take)
        if not spaces:
            self._fields[space, name] = field

    async def _set(self, space: str, name: str, text: str) -> None:
        """Set a parameter; after a refusal its reason is shown and the present value returns."""
        node = f"{space}/{self._kind}"
        values = self._graph.parameters.get(node, {})
        if name in values and text:
            try:
                value = parse_value(text, values[name])
            except FaultError as error:
                await self._carefully(_raise(error))
            else:
                await self._carefully(self._graph.set_parameter(node, name, value))
        # Dropped, so that the next poll shows the present value, also after an emptied field or a refusal.
        self._shown.pop((space, name), None)


async def _raise(error: Exception) -> None:
    raise error
