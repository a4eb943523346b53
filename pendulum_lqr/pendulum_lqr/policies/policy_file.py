"""Policy files: one ``.npz`` whose content is checked in full before any of it is used.

A zip archive of arrays: ``header`` (JSON as bytes), ``weight_k`` and ``bias_k`` of each layer, ``test_observations``
and ``test_actions``, recomputed on loading to detect different arithmetic and damaged files. No pickles; sizes are
bounded before reading.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.policies.bounded_files import read_bounded, read_parts, sentence_of, shown
from pendulum_lqr.policies.policy import MODELS, Network, Policy, fingerprint, model_of
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import DataError, PendulumError
from pendulum_msgs_py.plants.plant_differences import describe_plants, read_plants

__all__ = [
    "FORMAT",
    "LARGEST_FILE",
    "POLICY_SUFFIX",
    "dumps_policy",
    "header_of",
    "load_policy",
    "loads_policy",
    "named_controller",
    "policy_record",
    "write_policy",
]

FORMAT = "pendulum_policy/1"
POLICY_SUFFIX = ".npz"
"""Suffix of policy files, also where a controller's name is possible."""
LARGEST_FILE = 4_000_000
"""Largest file, and largest sum of its arrays [bytes]: a network of 64 x 64 takes 20 thousand."""
_LARGEST_HEADER = 100_000
_MOST_LAYERS = 8
_TEST_VECTORS = 16
_TOLERANCE = 1e-4
"""Tolerance of recomputed test vectors: other processors add in another order [-]."""
_VECTORS = ("effort_limit", "effort_rate", "velocity_scale", "angle_box", "velocity_box")
_KEYS = {
    "format", "model", "name", "task", "joints", "period", "plant", "fingerprint", "ranges", *_VECTORS, "signals",
    "history", "activation", "output", "layers", "provenance",
}  # fmt: skip


def write_policy(path: str | Path, policy: Policy) -> Path:
    """Write a policy file, atomically; DataError if it cannot be written."""
    path = Path(path)
    content = dumps_policy(policy)
    with writing(f"policy file {path}", DataError):
        write_atomically(path, content)
    return path


def dumps_policy(policy: Policy) -> bytes:
    """Return the content of a policy file; equal policies give equal bytes."""
    network = policy.network
    vectors = np.random.default_rng(0).uniform(-1.0, 1.0, (_TEST_VECTORS, network.sizes[0])).astype(np.float32)
    arrays: dict[str, NDArray[Any]] = {"header": np.frombuffer(_header_text(policy).encode(), dtype=np.uint8)}
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays[f"weight_{k}"] = np.ascontiguousarray(weight, dtype=np.float32)
        arrays[f"bias_{k}"] = np.ascontiguousarray(bias, dtype=np.float32)
    arrays["test_observations"] = vectors
    arrays["test_actions"] = network.forward(vectors)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            entry = io.BytesIO()
            np.lib.format.write_array(entry, array, version=(1, 0), allow_pickle=False)
            # A fixed date: the bytes depend on the policy alone.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), entry.getvalue())
    content = buffer.getvalue()
    if len(content) > LARGEST_FILE:
        raise DataError(f"policy {policy.name!r} takes {len(content)} bytes; expected at most {LARGEST_FILE}")
    return content


def load_policy(path: str | Path) -> Policy:
    """Return the policy of a file.

    Raises:
        DataError: The file is missing, too large, no policy, damaged, or of a version that computes otherwise.
    """
    path = Path(path).expanduser()
    where = f"policy file {path}"
    return loads_policy(read_bounded(path, where, LARGEST_FILE), where)


def named_controller(text: str) -> tuple[str, dict[str, str]]:
    """Return kind and parameters of a named controller or of a policy file, by suffix; DataError if unreadable."""
    if not text.endswith(POLICY_SUFFIX):
        return text, {}
    load_policy(text)
    return "policy", {"policy": str(Path(text).expanduser().resolve())}


def policy_record(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return ``policy_sha256`` for a run's record, because the file may change; empty without a readable policy."""
    path = parameters.get("policy")
    if not isinstance(path, str) or not path:
        return {}
    try:
        content = read_bounded(Path(path).expanduser(), f"policy file {path}", LARGEST_FILE)
    except DataError:
        return {}
    return {"policy_sha256": hashlib.sha256(content).hexdigest()}


def loads_policy(content: bytes, where: str = "policy") -> Policy:
    """Return the policy of a file's content; ``where`` is for messages. Raises as :func:`load_policy`."""
    try:
        arrays = _read_arrays(content)
        header = _read_header(arrays.pop("header"))
        tests = arrays.pop("test_observations"), arrays.pop("test_actions")
        policy = _build(header, arrays)
        _recompute(policy.network, *tests)
    except PendulumError as error:
        raise DataError(f"{where} is refused: {error}") from error
    return policy


def header_of(policy: Policy) -> dict[str, Any]:
    """Return a policy as JSON values, without its weights."""
    network = policy.network
    return {
        "format": FORMAT,
        "model": model_of(policy.plant),
        "name": policy.name,
        "task": policy.task,
        "joints": list(policy.joints),
        "period": policy.period,
        "plant": json.loads(describe_plants([policy.plant]))[0],
        "fingerprint": fingerprint(policy.plant),
        "ranges": {name: list(pair) for name, pair in policy.ranges.items()},
        # JSON has no infinity: an unbounded rate is null.
        **{name: [v if math.isfinite(v) else None for v in getattr(policy, name)] for name in _VECTORS},
        "signals": list(policy.signals),
        "history": policy.history,
        "activation": network.activation,
        "output": network.output,
        "layers": list(network.sizes),
        "provenance": dict(policy.provenance),
    }


def _header_text(policy: Policy) -> str:
    try:
        text = json.dumps(header_of(policy), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise DataError(f"provenance of policy {policy.name!r} holds what JSON has no word for: {error}") from error
    if len(text) > _LARGEST_HEADER:
        raise DataError(f"header of policy {policy.name!r} has {len(text)} bytes; expected at most {_LARGEST_HEADER}")
    return text


def _read_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive, after a check of names and sizes."""
    if len(content) > LARGEST_FILE:
        raise DataError(f"it has {len(content)} bytes; expected at most {LARGEST_FILE}")
    names: list[str] = []

    def check(entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
        names[:] = [entry.filename.removesuffix(".npy") for entry in entries]
        layers = sum(name.startswith("weight_") for name in names)
        expected = {"header", "test_observations", "test_actions"}
        expected |= {f"{kind}_{k}" for kind in ("weight", "bias") for k in range(layers)}
        if len(names) != len(set(names)) or set(names) != expected or not 1 <= layers <= _MOST_LAYERS:
            raise DataError(f"it holds {shown(names)}; expected header, weight_k, bias_k and test vectors")
        total = sum(entry.file_size for entry in entries)
        if total > LARGEST_FILE:
            raise DataError(f"its arrays take {total} bytes; expected at most {LARGEST_FILE}")
        return entries

    parts = read_parts(content, ".npz", check)
    return {
        name: _read_array(name, data, np.uint8 if name == "header" else np.float32)
        for name, data in zip(names, parts, strict=True)
    }


def _read_array(name: str, data: bytes, kind: type[np.generic]) -> NDArray[Any]:
    """Return one array, after a comparison of its shape with the available bytes."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise DataError(f"array {name} has version {version} of the format; expected (1, 0)")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"array {name} has no header that numpy reads ({sentence_of(error)})") from error
    if dtype != np.dtype(kind) or fortran:
        raise DataError(f"array {name} holds {dtype}; expected {np.dtype(kind)} in C order")
    left = len(data) - stream.tell()
    if any(type(size) is not int or size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != left:
        raise DataError(f"array {name} of shape {shown(shape)} has {left} bytes; expected as many as its shape says")
    return np.frombuffer(data, dtype=kind, offset=stream.tell()).reshape(shape)


def _read_header(raw: NDArray[Any]) -> dict[str, Any]:
    if raw.size > _LARGEST_HEADER:
        raise DataError(f"header has {raw.size} bytes; expected at most {_LARGEST_HEADER}")
    try:
        header = json.loads(raw.tobytes().decode(), parse_constant=_refuse_constant, object_pairs_hook=_once)
    except DataError:
        raise
    except (ValueError, RecursionError) as error:
        raise DataError(f"header is no JSON ({sentence_of(error)})") from error
    if not isinstance(header, dict):
        raise DataError(f"header is a {type(header).__name__}; expected a mapping")
    if header.get("format") != FORMAT:
        raise DataError(f"format is {shown(header.get('format'))}; expected {FORMAT!r}")
    if header.get("model") not in MODELS:
        raise DataError(f"model is {shown(header.get('model'))}; expected {' or '.join(map(repr, MODELS))}")
    if set(header) != _KEYS:
        wrong = min(set(header) ^ _KEYS)
        raise DataError(f"header {'lacks' if wrong in _KEYS else 'has the unknown key'} {shown(wrong)}")
    return header


def _build(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Policy:
    layers = range(sum(name.startswith("weight_") for name in arrays))
    network = Network(
        tuple(arrays[f"weight_{k}"] for k in layers),
        tuple(arrays[f"bias_{k}"] for k in layers),
        activation=_text(header, "activation"),
        output=_text(header, "output"),
    )
    if header["layers"] != list(network.sizes):
        raise DataError(f"layers are {shown(header['layers'])}; the weights say {list(network.sizes)}")
    plant = read_plants(json.dumps([header["plant"]]))[0]
    if header["model"] != model_of(plant):
        raise DataError(f"model is {shown(header['model'])}; its plant is {model_of(plant)!r}")
    if header["fingerprint"] != fingerprint(plant):
        raise DataError(f"fingerprint is {shown(header['fingerprint'])}; its plant has {fingerprint(plant)}")
    if type(header["history"]) is not int:
        raise DataError(f"history is {shown(header['history'])}; expected a whole number")
    ranges, provenance = header["ranges"], header["provenance"]
    if not isinstance(ranges, dict) or not isinstance(provenance, dict):
        raise DataError("ranges or provenance is no mapping")
    pairs = {name: _numbers(pair, f"range of {name}", "") for name, pair in ranges.items()}
    if any(len(pair) != 2 for pair in pairs.values()):
        raise DataError(f"ranges are {shown(ranges)}; expected [low, high] for each")
    vectors = {name: _numbers(header[name], name, name) for name in _VECTORS}
    return Policy(
        network=network,
        name=_text(header, "name"),
        task=_text(header, "task"),
        joints=_texts(header, "joints"),
        period=_numbers([header["period"]], "period", "")[0],
        plant=plant,
        ranges={name: (pair[0], pair[1]) for name, pair in pairs.items()},
        signals=_texts(header, "signals"),
        history=header["history"],
        provenance=provenance,
        **vectors,
    )


def _recompute(network: Network, observations: NDArray[Any], actions: NDArray[Any]) -> None:
    sizes = network.sizes
    if observations.ndim != 2 or not observations.size or observations.shape[1] != sizes[0]:
        raise DataError(f"test_observations has shape {observations.shape}; expected (k, {sizes[0]}) with k > 0")
    if actions.shape != (len(observations), sizes[-1]):
        raise DataError(f"test_actions has shape {actions.shape}; expected ({len(observations)}, {sizes[-1]})")
    error = float(np.max(np.abs(network.forward(observations) - actions), initial=0.0))
    if not error <= _TOLERANCE:
        raise DataError(f"its test vectors come out wrong by {error:.3g}; expected at most {_TOLERANCE:g}")


def _refuse_constant(word: str) -> NoReturn:
    raise DataError(f"header holds {word}; expected finite numbers")


def _once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise DataError("header has a key that is given twice")
    return found


def _numbers(values: Any, what: str, name: str) -> tuple[float, ...]:
    """Return finite numbers; for the rate of the torque, null is infinity."""
    if isinstance(values, list):
        free = name == "effort_rate"
        given = [math.inf if value is None and free else value for value in values]
        good = [type(value) in {int, float} and (abs(value) < 1e300 or (free and value == math.inf)) for value in given]
        if all(good):
            return tuple(float(value) for value in given)
    raise DataError(f"{what} is {shown(values)}; expected finite numbers")


def _text(header: Mapping[str, Any], key: str) -> str:
    value = header[key]
    if not isinstance(value, str) or not value.isprintable() or len(value) > 200:
        raise DataError(f"{key} is {shown(value)}; expected a line of text")
    return value


def _texts(header: Mapping[str, Any], key: str) -> tuple[str, ...]:
    values = header[key]
    if not isinstance(values, list):
        raise DataError(f"{key} is {shown(values)}; expected a list")
    return tuple(_text({key: value}, key) for value in values)
