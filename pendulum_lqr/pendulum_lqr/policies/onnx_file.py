"""Policies as ONNX models, written without the library ``onnx``.

Input ``observation`` (N, in), output ``action`` (N, out) within [-1, 1], in single precision: Gemm, Tanh or Relu, and
Clip or Tanh at the end. ``metadata_props`` has the policy file's header, each value as JSON, and ``observation``, the
meaning of each input. Source: ONNX, ``onnx.proto3`` (intermediate representation 8), operators of opset 13; Protocol
Buffers, "Encoding".
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.policies.policy import Network, Policy
from pendulum_lqr.policies.policy_file import header_of
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import DataError

__all__ = ["OPSET", "dumps_onnx", "observation_names", "write_onnx"]

OPSET = 13
"""First opset with the present form of every operator used here."""
_IR_VERSION = 8
_FLOAT, _INT = 1, 2
_NOTE = "u = effort_limit * action, limited to a change of effort_rate * period; observation as metadata_props says"


def write_onnx(path: str | Path, policy: Policy) -> Path:
    """Write a policy as an ONNX model, atomically; DataError if it cannot be written."""
    path = Path(path)
    with writing(f"model {path}", DataError):
        write_atomically(path, dumps_onnx(policy))
    return path


def dumps_onnx(policy: Policy) -> bytes:
    """Return the ONNX model of a policy; equal policies give equal bytes."""
    metadata: dict[str, Any] = {**header_of(policy), "observation": observation_names(policy)}
    return b"".join(
        (
            _number(1, _IR_VERSION),
            _text(2, "pendulum_lqr"),
            _field(7, _graph(policy.network)),
            _field(8, _text(1, "") + _number(2, OPSET)),
            *(
                _field(14, _text(1, key) + _text(2, json.dumps(metadata[key], sort_keys=True, allow_nan=False)))
                for key in sorted(metadata)
            ),
        )
    )


def observation_names(policy: Policy) -> list[str]:
    """Return the meaning of each input, as ``joint: signal, sample``; sample 0 is the newest."""
    return [
        f"{policy.joints[joint]}: {signal}, sample {-age}"
        for age in range(policy.history - 1, -1, -1)
        for signal, joint in policy.layout
    ]


def _graph(network: Network) -> bytes:
    nodes: list[bytes] = []
    tensors: list[bytes] = []
    value, last = "observation", len(network.weights) - 1
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors += [_tensor(f"weight_{k}", weight), _tensor(f"bias_{k}", bias)]
        nodes.append(_node("Gemm", [value, f"weight_{k}", f"bias_{k}"], f"sum_{k}", _transposed()))
        value = f"sum_{k}"
        if k < last:
            nodes.append(_node("Tanh" if network.activation == "tanh" else "Relu", [value], f"layer_{k}"))
            value = f"layer_{k}"
    if network.output == "tanh":
        nodes.append(_node("Tanh", [value], "action"))
    else:
        tensors += [_tensor(name, np.float32(end)) for name, end in (("low", -1.0), ("high", 1.0))]
        nodes.append(_node("Clip", [value, "low", "high"], "action"))
    return b"".join(
        (
            *(_field(1, node) for node in nodes),
            _text(2, "policy"),
            *(_field(5, tensor) for tensor in tensors),
            _text(10, _NOTE),
            _field(11, _matrix("observation", network.sizes[0])),
            _field(12, _matrix("action", network.sizes[-1])),
        )
    )


def _node(operator: str, inputs: Sequence[str], output: str, attribute: bytes = b"") -> bytes:
    names = b"".join(_text(1, name) for name in inputs)
    return names + _text(2, output) + _text(3, output) + _text(4, operator) + attribute


def _transposed() -> bytes:
    return _field(5, _text(1, "transB") + _number(3, 1) + _number(20, _INT))


def _tensor(name: str, values: NDArray[np.float32] | np.float32) -> bytes:
    array = np.asarray(values, dtype="<f4")
    shape = b"".join(_number(1, size) for size in array.shape)
    return shape + _number(2, _FLOAT) + _text(8, name) + _field(9, array.tobytes())


def _matrix(name: str, width: int) -> bytes:
    """Return the type of a value with any number of rows."""
    shape = _field(1, _text(2, "N")) + _field(1, _number(1, width))
    return _text(1, name) + _field(2, _field(1, _number(1, _FLOAT) + _field(2, shape)))


def _text(field: int, text: str) -> bytes:
    return _field(field, text.encode())


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)
