"""The import rules that import-linter has no word for: only thin shells may touch ROS, and no import goes in a circle.

A module is a shell when its name matches one of the patterns in ``pyproject.toml``; every other module is
pure core. The core may import neither a ROS package nor a shell, so that it runs, and is tested, where no
ROS is installed. Entry points (command lines) start shells and so may import them, but not ROS itself.
"""

from __future__ import annotations

from fnmatch import fnmatch

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output

__all__ = ["NoCirclesContract", "RoomsContract", "RosShellsContract"]


class RosShellsContract(Contract):
    """Forbid ROS in everything but the shells, directly or through one of them."""

    type_name = "ros_shells"

    shells = fields.SetField(subfield=fields.StringField())
    ros_packages = fields.SetField(subfield=fields.StringField())
    entry_points = fields.SetField(subfield=fields.StringField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Look at each direct import: a chain from the core to ROS must pass one of them."""
        external = {module for module in graph.modules if graph.is_module_squashed(module)}
        ros = {module for module in external if _matches(module, self.ros_packages)}
        shells = {module for module in graph.modules - external if _matches(module, self.shells)}
        entry_points = {module for module in graph.modules - external if _matches(module, self.entry_points)}
        offences = [
            (importer, imported, detail["line_number"], detail["line_contents"])
            for importer in sorted(graph.modules - external - shells)
            for imported in sorted(graph.find_modules_directly_imported_by(importer))
            if imported in ros or (imported in shells and importer not in entry_points)
            for detail in graph.get_import_details(importer=importer, imported=imported)
        ]
        return ContractCheck(kept=not offences, metadata={"offences": offences})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Name each offence by module and line."""
        for importer, _, line, text in check.metadata["offences"]:
            output.print_error(f"{importer}, line {line}: {text}", bold=False)
        output.print_error("expected: ROS and its shells imported by *_node modules and ros subpackages only")


class NoCirclesContract(Contract):
    """Forbid imports in a circle between modules, those in functions and for types among them."""

    type_name = "no_circles"

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Leave out, again and again, every module that imports nothing of the rest; what stays is on a circle."""
        left = {module for module in graph.modules if not graph.is_module_squashed(module)}
        for sides in (graph.find_modules_directly_imported_by, graph.find_modules_that_directly_import):
            while gone := {module for module in left if not sides(module) & left - {module}}:
                left -= gone
        return ContractCheck(kept=not left, metadata={"circle": self._imports_within(graph, left)})

    @staticmethod
    def _imports_within(graph: ImportGraph, left: set[str]) -> list[str]:
        return [
            f"{importer}, line {detail['line_number']}: {detail['line_contents']}"
            for importer in sorted(left)
            for imported in sorted(graph.find_modules_directly_imported_by(importer) & left)
            for detail in graph.get_import_details(importer=importer, imported=imported)
        ]

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Name each import that is part of a circle, or on the way from one to another."""
        for line in check.metadata["circle"]:
            output.print_error(line, bold=False)
        output.print_error("expected: imports that go one way; move what both need into a module of its own")


class RoomsContract(Contract):
    """Forbid cyclic imports between the subpackages and modules of one folder."""

    type_name = "rooms"

    packages = fields.SetField(subfield=fields.StringField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Look at each folder by itself: what lies in it imports each other one way."""
        ours = {module for package in self.packages for module in {package, *graph.find_descendants(package)}}
        imports = [
            (importer, imported)
            for importer in sorted(ours)
            for imported in sorted(graph.find_modules_directly_imported_by(importer) & ours)
        ]
        folders = sorted(module for module in ours if graph.find_children(module))
        offences = [told for folder in folders for told in self._circle_within(folder, imports)]
        return ContractCheck(kept=not offences, metadata={"offences": offences})

    @staticmethod
    def _circle_within(folder: str, imports: list[tuple[str, str]]) -> list[str]:
        """Leave out, again and again, what imports none of the rest or what none imports; the rest is a circle."""
        between: dict[str, dict[str, str]] = {}
        depth = folder.count(".") + 2
        for importer, imported in imports:
            if all(module.startswith(f"{folder}.") for module in (importer, imported)):
                at, to = (".".join(module.split(".")[:depth]) for module in (importer, imported))
                if at != to:
                    between.setdefault(at, {}).setdefault(to, f"{importer} imports {imported}")
                    between.setdefault(to, {})
        left = set(between)
        while gone := {
            one for one in left if not between[one].keys() & left or not any(one in between[other] for other in left)
        }:
            left -= gone
        return [told for one in sorted(left) for to, told in between[one].items() if to in left]

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Name one import for each pair on a circle."""
        for line in check.metadata["offences"]:
            output.print_error(line, bold=False)
        output.print_error("expected: rooms that import each other one way; move what both need into one below them")


def _matches(module: str, patterns: set[str]) -> bool:
    return any(fnmatch(module, pattern) for pattern in patterns)
