"""Kept machine code that is not what it should be: it is refused with its reason, and compiled anew where it can be."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pendulum_msgs_py.loops import machine_code
from pendulum_msgs_py.loops.machine_code import NoMachineCodeError, load_loop

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="loops are compiled on Linux for x86_64"
)

_ELF = b"\x7fELF\x02\x01" + bytes(58)
_BUILDER = "pendulum_msgs_py.loops.nothing:nothing"


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return where the code of a loop is kept; its compiler keeps nothing."""
    path = tmp_path / "nothing.loop"
    monkeypatch.setattr(machine_code, "_path", lambda *_: path)
    monkeypatch.setattr(machine_code, "_compile_apart", lambda *_: None)
    machine_code._load.cache_clear()
    yield path
    machine_code._load.cache_clear()


def _kept(head: object, code: bytes) -> bytes:
    return json.dumps(head).encode() + b"\n" + code


def _head(code: bytes, **changed: object) -> dict[str, object]:
    return {"name": "loop", "digest": hashlib.sha256(code).hexdigest(), "sources": {}} | changed


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\n",
        *(_kept(head, _ELF) for head in ([], 1, None, "x", {}, _head(_ELF, digest="0"), _head(_ELF, sources=None),
                                         _head(_ELF, name=None),
                                         _head(_ELF, sources={"pendulum_msgs_py/errors.py": "0"}),
                                         _head(_ELF, sources={__file__: _digest(Path(__file__))}),
                                         _head(_ELF, sources={"pendulum_nobody/nothing.py": "0"}),
                                         _head(_ELF, sources={"/nowhere": "0"}), _head(_ELF, sources={"\0": "0"}))),
    ],
    ids=range(15),
)  # fmt: skip
def test_what_somebody_else_has_written_counts_as_not_there(kept: Path, content: bytes) -> None:
    kept.write_bytes(content)
    with pytest.raises(NoMachineCodeError, match="cannot be read back"):
        load_loop(_BUILDER, symbols={})


def test_of_the_sources_those_of_the_packages_here_count(kept: Path) -> None:
    """A copy of a folder takes what is kept along, and is changed while the folder that it came from is not."""
    here = Path(machine_code.__file__).parent / "object_file.py"
    kept.write_bytes(_kept(_head(b"", sources={"pendulum_msgs_py/loops/object_file.py": _digest(here)}), b""))
    with pytest.raises(NoMachineCodeError, match="cannot be loaded"):  # so it was read back
        load_loop(_BUILDER, symbols={})


@pytest.mark.parametrize("code", [b"", _ELF, _ELF[:18] + b"\xb7" + _ELF[19:], _ELF[:18] + b"\x3e" + b"\xff" * 45],
                         ids=["empty", "no machine", "another machine", "damaged"])  # fmt: skip
def test_code_that_is_no_code_of_ours_is_refused(kept: Path, code: bytes) -> None:
    kept.write_bytes(_kept(_head(code), code))
    with pytest.raises(NoMachineCodeError, match="cannot be loaded"):
        load_loop(_BUILDER, symbols={})


def test_a_user_without_a_home_gets_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(machine_code.os, "access", lambda *_: False)
    monkeypatch.setattr(Path, "home", nobody)
    with pytest.raises(NoMachineCodeError, match="no folder for machine code"):
        machine_code._path("pendulum_msgs_py.loops.nothing:nothing", ())
