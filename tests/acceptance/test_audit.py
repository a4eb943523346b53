"""The audit finds what is vulnerable, and never takes silence for a good answer."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from pendulum_testing.fixtures import PROJECT
from tests.audit import Finding, from_advisories, from_pip_audit, main, pinned


def advisory(name: str, *events: dict[str, str], **more: Any) -> dict[str, Any]:
    affected = {
        "package": {"name": name, "ecosystem": "PyPI"},
        "ranges": [{"type": "ECOSYSTEM", "events": list(events)}],
    }
    return {"id": "PYSEC-1", "affected": [affected], **more}


def database(folder: Path, *advisories: dict[str, Any]) -> Path:
    path = folder / "all.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for number, content in enumerate(advisories):
            archive.writestr(f"PYSEC-{number}.json", json.dumps(content))
    return path


def fake_pip_audit(folder: Path, report: object) -> Path:
    """Write a program that answers as pip-audit does; the real one asks a server that is not here."""
    path = folder / "pip-audit"
    path.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps(report)}\nEND\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def test_every_pin_of_the_lock_is_found() -> None:
    pins = pinned(*(lock.read_text(encoding="utf-8") for lock in (PROJECT / "requirements").glob("*.txt")))
    assert len(pins) > 250
    # One for each of the interpreters that numpy serves with different versions.
    assert len(pins["numpy"]) > 1
    assert all(version.startswith("2.") for version in pins["numpy"])
    assert not [name for name in pins if name != name.lower()]


@pytest.mark.parametrize(
    ("version", "events", "hit"),
    [
        ("1.0", [{"introduced": "0"}, {"fixed": "1.1"}], True),
        ("1.1", [{"introduced": "0"}, {"fixed": "1.1"}], False),
        ("1.10", [{"introduced": "1.2"}, {"fixed": "1.9"}, {"introduced": "1.10"}], True),
        ("1.9", [{"introduced": "1.2"}, {"fixed": "1.9"}, {"introduced": "1.10"}], False),
        ("2.0", [{"introduced": "1.0"}, {"last_affected": "2.0"}], True),
        ("2.1", [{"introduced": "1.0"}, {"last_affected": "2.0"}], False),
        ("0.9", [{"introduced": "1.0"}], False),
    ],
)
def test_ranges_of_versions_are_those_of_the_format(
    tmp_path: Path, version: str, events: list[dict[str, str]], hit: bool
) -> None:
    found = from_advisories(database(tmp_path, advisory("My_Package", *events)), {"my-package": {version}})
    assert bool(found) is hit


def test_withdrawn_and_foreign_advisories_do_not_count(tmp_path: Path) -> None:
    withdrawn = advisory("a", {"introduced": "0"}, withdrawn="2024-01-01T00:00:00Z")
    foreign = advisory("a", {"introduced": "0"})
    foreign["affected"][0]["package"]["ecosystem"] = "npm"
    assert from_advisories(database(tmp_path, withdrawn, foreign), {"a": {"1.0"}}) == []


def test_silence_is_an_error_and_a_finding_a_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock = tmp_path / "lock.txt"
    lock.write_text("jinja2==2.10 \\\n    --hash=sha256:00\nnumpy==1.26.4\n", encoding="utf-8")
    skipped = [{"name": name, "skip_reason": "Dependency not found on PyPI"} for name in ("jinja2", "numpy")]
    silent = fake_pip_audit(tmp_path, {"dependencies": skipped, "fixes": []})
    assert main([str(lock), "--program", str(silent)]) == 2
    assert "none of the 2 pins" in capsys.readouterr().err
    found = {"name": "jinja2", "version": "2.10", "vulns": [{"id": "PYSEC-7", "fix_versions": ["2.10.1"]}]}
    report = {"dependencies": [found, skipped[1]], "fixes": []}
    assert from_pip_audit(report) == ({"jinja2"}, [Finding("jinja2", "2.10", "PYSEC-7", "2.10.1")])
    assert main([str(lock), "--program", str(fake_pip_audit(tmp_path, report))]) == 1
    told = capsys.readouterr().out
    assert "PYSEC-7" in told
    assert "1 known vulnerabilities in 1 of 2 pins; not known there: numpy" in told
    assert main([str(lock), "--program", str(tmp_path / "none")]) == 2
    assert "pip-audit does not run" in capsys.readouterr().err


def test_an_export_is_asked_without_a_network(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock = tmp_path / "lock.txt"
    lock.write_text("jinja2==2.10\n", encoding="utf-8")
    export = database(tmp_path, advisory("jinja2", {"introduced": "0"}, {"fixed": "2.10.1"}))
    assert main([str(lock), "--advisories", str(export), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["findings"] == [{"package": "jinja2", "version": "2.10", "advisory": "PYSEC-1", "fixed_in": "2.10.1"}]
    lock.write_text("jinja2==3.1\n", encoding="utf-8")
    assert main([str(lock), "--advisories", str(export)]) == 0
    export.write_bytes(b"no zip")
    assert main([str(lock), "--advisories", str(export)]) == 2
    assert "cannot be read" in capsys.readouterr().err
