"""Weights from a ``torch.save`` file, read without torch and without executing anything.

The zip archive has ``data.pkl``, a pickle that lists the tensors, and ``data/<key>`` with their numbers. The pickle is
not unpickled: its operations are read one by one, and anything other than tensors in a dictionary, or a name of code
outside ``_NAMES``, is refused. Source: PyTorch, "Serialization semantics", format of ``torch.save``; Python,
``pickletools``.
"""

from __future__ import annotations

import math
import pickletools
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.policies.bounded_files import read_parts, sentence_of, shown
from pendulum_msgs_py.errors import DataError

__all__ = ["LARGEST_STATE", "read_state"]

LARGEST_STATE = 32_000_000
"""Largest sum of a file's parts [bytes]: actor and critics of 400 x 300 take 4 million."""
_LARGEST_PICKLE = 1_000_000
_MOST_TENSORS = 1000
_MOST_AXES = 8
_DTYPES: dict[str, np.dtype[Any]] = {"FloatStorage": np.dtype("<f4"), "DoubleStorage": np.dtype("<f8")}
_NAMES = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2", *(f"torch {name}" for name in _DTYPES)}


class _Name(NamedTuple):
    """A name of code that is only compared, never imported."""

    text: str


class _Storage(NamedTuple):
    dtype: np.dtype[Any]
    key: str
    size: int


class _Tensor(NamedTuple):
    storage: _Storage
    offset: int
    shape: tuple[int, ...]


def read_state(content: bytes) -> dict[str, NDArray[np.float32]]:
    """Return the tensors by name of a ``state_dict`` written by ``torch.save``.

    Raises:
        DataError: It is no such file, damaged, too large, or holds more than named tensors of finite numbers.
    """
    names: list[str] = []

    def check(entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
        total = sum(entry.file_size for entry in entries)
        if total > LARGEST_STATE:
            raise DataError(f"its parts take {total} bytes; expected at most {LARGEST_STATE}")
        # All are in one folder of any name.
        names[:] = [entry.filename.partition("/")[2] for entry in entries]
        if len(set(names)) != len(names) or "data.pkl" not in names:
            raise DataError(
                f"it holds {shown(sorted(names)[:8])}; expected data.pkl and data/0, data/1, ..., each once"
            )
        return entries

    contents = read_parts(content, "torch", check)
    parts = dict(zip(names, contents, strict=True))
    if parts.get("byteorder", b"little") != b"little":
        raise DataError(f"its byte order is {shown(parts['byteorder'])}; expected little")
    return {name: _array(name, tensor, parts) for name, tensor in _tensors(parts["data.pkl"]).items()}


def _array(name: str, tensor: _Tensor, parts: dict[str, bytes]) -> NDArray[np.float32]:
    dtype, key, size = tensor.storage
    data = parts.get(f"data/{key}")
    if data is None or len(data) != size * dtype.itemsize:
        there = "none" if data is None else len(data)
        raise DataError(f"tensor {shown(name)} needs {size * dtype.itemsize} bytes of data/{key} and there are {there}")
    count = math.prod(tensor.shape)
    if tensor.offset + count > size:
        raise DataError(f"tensor {shown(name)} of shape {tensor.shape} goes beyond its data")
    values = np.frombuffer(data, dtype=dtype, offset=tensor.offset * dtype.itemsize, count=count)
    if not np.isfinite(values).all():
        raise DataError(f"tensor {shown(name)} has a value that is not finite")
    return values.reshape(tensor.shape).astype(np.float32)


def _tensors(pickled: bytes) -> dict[str, _Tensor]:
    if len(pickled) > _LARGEST_PICKLE:
        raise DataError(f"data.pkl has {len(pickled)} bytes; expected at most {_LARGEST_PICKLE}")
    try:
        found = _Reader().read(pickled)
    except DataError:
        raise
    except Exception as error:  # whatever pickletools meets in bytes that are no pickle
        raise DataError(f"data.pkl is no whole pickle ({sentence_of(error)})") from error
    if not isinstance(found, dict) or not found or len(found) > _MOST_TENSORS:
        raise DataError(f"data.pkl holds {shown(type(found).__name__)}; expected 1 to {_MOST_TENSORS} named tensors")
    for name, value in found.items():
        if not isinstance(name, str) or not isinstance(value, _Tensor):
            raise DataError("data.pkl holds an item that is no named tensor")
    return found


class _Reader:
    """Interprets the operations of a pickle; messages show none of its values, which could take forever to print."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def read(self, pickled: bytes) -> Any:
        """Return the described object."""
        for operation, argument, _ in pickletools.genops(pickled):
            if operation.name == "STOP":
                return self._stack.pop()
            action = _OPERATIONS.get(operation.name)
            if action is None:
                raise DataError(f"data.pkl has the operation {operation.name}; expected those of named tensors alone")
            action(self, argument)
        raise DataError("data.pkl has no end")

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def to_mark(self) -> list[Any]:
        at = self._marks.pop()
        taken, self._stack[at:] = self._stack[at:], []
        return taken

    def name(self, argument: str) -> None:
        if argument not in _NAMES:
            raise DataError(f"data.pkl names {shown(argument)}; expected tensors of torch in a dictionary alone")
        self.push(_Name(argument))

    def put(self, argument: int) -> None:
        self._memo[argument] = self._stack[-1]

    def get(self, argument: int) -> None:
        self.push(self._memo[argument])

    def tuple_of(self, count: int | None) -> None:
        if count is None:
            self.push(tuple(self.to_mark()))
        else:
            values = [self._stack.pop() for _ in range(count)]
            self.push(tuple(reversed(values)))

    def storage(self, _: Any) -> None:
        word, kind, key, _device, size = self._stack.pop()
        dtype = _DTYPES.get(kind.text.removeprefix("torch ")) if isinstance(kind, _Name) else None
        if word != "storage" or dtype is None or not isinstance(key, str) or type(size) is not int or size < 0:
            raise DataError("data.pkl asks for what is no float or double storage; expected numbers of 32 or 64 bits")
        self.push(_Storage(dtype, key, size))

    def reduce(self, _: Any) -> None:
        arguments, function = self._stack.pop(), self._stack.pop()
        if not isinstance(function, _Name) or not isinstance(arguments, tuple):
            raise DataError("data.pkl calls what has no name; expected tensors alone")
        if function.text == "collections OrderedDict" and not arguments:
            self.push({})
        elif function.text == "torch._utils _rebuild_tensor_v2":
            self.push(_tensor(*arguments[:4]))
        else:
            raise DataError(f"data.pkl calls {function.text} with {len(arguments)} argument(s); expected tensors alone")

    def set_items(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, dict) or len(pairs) % 2:
            raise DataError("data.pkl puts items into what is no dictionary")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if not isinstance(key, str) or key in target:
                raise DataError("data.pkl has a key twice, or one that is no text")
            target[key] = value

    def set_item(self, _: Any) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        self.set_items([key, value])

    def build(self, _: Any) -> None:
        """Drop torch's versions of its modules (``_metadata``)."""
        self._stack.pop()


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any) -> _Tensor:
    vectors = all(isinstance(each, tuple) and len(each) <= _MOST_AXES for each in (shape, stride))
    whole = vectors and all(type(size) is int and size >= 0 for each in (shape, stride, (offset,)) for size in each)
    steps = [math.prod(shape[k + 1 :]) for k in range(len(shape))] if whole else []
    if not isinstance(storage, _Storage) or not whole or list(stride) != steps:
        raise DataError("data.pkl has a tensor that is a part or a view of its data; expected it whole")
    return _Tensor(storage, offset, tuple(shape))


_Action = Callable[[_Reader, Any], None]
_OPERATIONS: dict[str, _Action] = {
    "PROTO": lambda _reader, _: None,
    "MARK": _Reader.mark,
    "GLOBAL": _Reader.name,
    "BINPUT": _Reader.put,
    "LONG_BINPUT": _Reader.put,
    "BINGET": _Reader.get,
    "LONG_BINGET": _Reader.get,
    "EMPTY_DICT": lambda reader, _: reader.push({}),
    "EMPTY_TUPLE": lambda reader, _: reader.push(()),
    "TUPLE": lambda reader, _: reader.tuple_of(None),
    "TUPLE1": lambda reader, _: reader.tuple_of(1),
    "TUPLE2": lambda reader, _: reader.tuple_of(2),
    "TUPLE3": lambda reader, _: reader.tuple_of(3),
    "NONE": lambda reader, _: reader.push(None),
    "NEWTRUE": lambda reader, _: reader.push(True),
    "NEWFALSE": lambda reader, _: reader.push(False),
    **dict.fromkeys(("BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1"), _Reader.push),
    "BINPERSID": _Reader.storage,
    "REDUCE": _Reader.reduce,
    "SETITEM": _Reader.set_item,
    "SETITEMS": lambda reader, _: reader.set_items(reader.to_mark()),
    "BUILD": _Reader.build,
}
