"""Are there known vulnerabilities in what the lock pins? ``make audit`` asks, and says when it could not.

pip-audit looks the pinned versions up on PyPI. Where that cannot be reached it skips them one by one and then reports
that it found nothing; here that is an error. Where there is no network, an export of the open database of
vulnerabilities does instead (https://google.github.io/osv.dev/data/, ``PyPI/all.zip``)::

    make audit ARGS="--advisories all.zip"
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from packaging.version import InvalidVersion, Version

from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_testing.fixtures import PROJECT

__all__ = ["Finding", "from_advisories", "from_pip_audit", "pinned"]

_PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", re.MULTILINE)
_LARGEST = 1 << 20

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True, order=True)
class Finding:
    """A pinned version with a known vulnerability."""

    package: str
    version: str
    advisory: str
    fixed_in: str = ""


def pinned(*locks: str) -> dict[str, set[str]]:
    """Return the pins of locks: normalised name -> versions, which differ between interpreters."""
    pins: dict[str, set[str]] = {}
    for name, version in _PIN.findall("\n".join(locks)):
        pins.setdefault(re.sub(r"[-_.]+", "-", name).lower(), set()).add(version)
    return pins


def from_pip_audit(report: Mapping[str, Any]) -> tuple[set[str], list[Finding]]:
    """Return the packages that pip-audit did look up, and what it found.

    Args:
        report: Its output in JSON.
    """
    looked_up = {entry["name"] for entry in report["dependencies"] if "skip_reason" not in entry}
    findings = [
        Finding(entry["name"], entry["version"], found["id"], ", ".join(found.get("fix_versions", [])))
        for entry in report["dependencies"]
        for found in entry.get("vulns", [])
    ]
    return looked_up, sorted(findings)


def from_advisories(path: Path, pins: Mapping[str, set[str]]) -> list[Finding]:
    """Look pins up in an export of the open database of vulnerabilities.

    Args:
        path: ZIP file of advisories in the OSV format.
        pins: Normalised name -> versions.

    Raises:
        DataError: It is no such file, or holds no advisory.
    """
    findings: set[Finding] = set()
    count = 0
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if entry.filename.endswith(".json") and entry.file_size <= _LARGEST:
                    count += 1
                    findings.update(_matches(json.loads(archive.read(entry)), pins))
    except (OSError, zipfile.BadZipFile, json.JSONDecodeError, KeyError, TypeError) as error:
        raise DataError(f"advisories {path} cannot be read: {error}; expected PyPI/all.zip of osv.dev") from error
    if not count:
        raise DataError(f"advisories {path} holds none; expected PyPI/all.zip of osv.dev")
    return sorted(findings)


def _matches(advisory: Mapping[str, Any], pins: Mapping[str, set[str]]) -> Iterator[Finding]:
    if advisory.get("withdrawn"):
        return
    for affected in advisory.get("affected", []):
        name = re.sub(r"[-_.]+", "-", affected["package"]["name"]).lower()
        if affected["package"]["ecosystem"] != "PyPI":
            continue
        ranges = [span["events"] for span in affected.get("ranges", []) if span["type"] == "ECOSYSTEM"]
        fixed = ", ".join(event["fixed"] for events in ranges for event in events if "fixed" in event)
        for version in pins.get(name, ()):
            if version in affected.get("versions", []) or any(_within(Version(version), events) for events in ranges):
                yield Finding(name, version, advisory["id"], fixed)


def _within(version: Version, events: Sequence[Mapping[str, str]]) -> bool:
    """Tell whether a version is affected: the last event at or before it decides."""
    affected = False
    for event in sorted(events, key=_position):
        kind, text = next(iter(event.items()))
        at = _version(text)
        if kind == "last_affected":
            affected = affected and version <= at
        elif kind in {"introduced", "fixed"} and version >= at:
            affected = kind == "introduced"
    return affected


def _position(event: Mapping[str, str]) -> tuple[Version, bool]:
    kind, text = next(iter(event.items()))
    return _version(text), kind != "introduced"


def _version(text: str) -> Version:
    try:
        return Version(text)
    except InvalidVersion:
        return Version("0")


def _ask_pip_audit(program: Path, locks: Sequence[Path]) -> Mapping[str, Any]:
    asked = [word for lock in locks for word in ("-r", str(lock))]
    command = [str(program), "--no-deps", "--disable-pip", "--progress-spinner", "off", *asked, "-f", "json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise DataError(f"pip-audit does not run: {error}; expected it in {program}") from error
    try:
        report: Mapping[str, Any] = json.loads(done.stdout)
    except json.JSONDecodeError as error:
        last = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise DataError(
            f"pip-audit ended with code {done.returncode} and without a report: {last}; nothing was audited"
        ) from error
    return report


@app.command(epilog="Example: python -m tests.audit --advisories all.zip requirements/run.txt")
def audit(
    locks: Annotated[list[Path] | None, typer.Argument(help="Locks to audit; by default all layers.")] = None,
    program: Annotated[Path, typer.Option(help="pip-audit.")] = Path(sys.prefix, ".audit", "bin", "pip-audit"),
    advisories: Annotated[
        Path | None, typer.Option(help="Look there instead of on PyPI: PyPI/all.zip of osv.dev.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> int:
    """Look the pinned versions up; code 1 for known vulnerabilities, 2 where they could not be looked up."""
    locks = locks or sorted((PROJECT / "requirements").glob("*.txt"))
    texts = []
    for lock in locks:
        try:
            texts.append(lock.read_text(encoding="utf-8"))
        except OSError as error:
            raise DataError(f"lock {lock} cannot be read: {error.strerror}") from error
        if not pinned(texts[-1]):
            raise DataError(f"lock {lock} pins nothing; expected lines such as numpy==2.4.6")
    pins = pinned(*texts)
    if advisories is not None:
        looked_up, findings = set(pins), from_advisories(advisories, pins)
    else:
        looked_up, findings = from_pip_audit(_ask_pip_audit(program, locks))
        if not looked_up:
            names = ", ".join(lock.name for lock in locks)
            raise DataError(
                f"none of the {len(pins)} pins of {names} could be looked up: PyPI's data on "
                "vulnerabilities (https://pypi.org/pypi/NAME/VERSION/json) cannot be reached from here; "
                "nothing was audited"
            )
    if as_json:
        content = {"pins": len(pins), "looked_up": len(looked_up), "findings": [vars(finding) for finding in findings]}
        print(json.dumps(content, indent=2))
        return 1 if findings else 0
    if findings:
        table = WholeTable("package", "version", "advisory", "fixed in", title="Known vulnerabilities")
        for finding in findings:
            table.add_row(finding.package, finding.version, finding.advisory, finding.fixed_in)
        make_console().print(table)
    # Wheels of ROS come from another index; nobody collects advisories on them.
    left_out = f"; not known there: {', '.join(missing)}" if (missing := sorted(set(pins) - looked_up)) else ""
    print(f"{len(findings)} known vulnerabilities in {len(looked_up)} of {len(pins)} pins{left_out}")
    return 1 if findings else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.audit")


if __name__ == "__main__":
    raise SystemExit(main())
