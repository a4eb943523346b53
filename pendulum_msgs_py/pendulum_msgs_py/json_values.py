"""Values that JSON can represent."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

__all__ = ["json_text", "without_nan"]


def json_text(content: Any) -> str:
    """Return standard JSON: ``null`` for NaN and infinity, numpy values as Python's, other types as text."""
    return json.dumps(without_nan(content), indent=2, allow_nan=False, default=_plain)


def without_nan(value: Any) -> Any:
    """Return a value with None for NaN and infinity, also in containers."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_key(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return value


def _key(key: Any) -> Any:
    plain = isinstance(key, str | int) or key is None or (isinstance(key, float) and math.isfinite(key))
    return key if plain else str(key)


def _plain(value: Any) -> Any:
    plain = value.tolist() if hasattr(value, "tolist") else None
    # For a number with more digits than Python's, tolist() returns numpy's type.
    return str(value) if plain is None or type(plain) is type(value) else without_nan(plain)
