"""What a page that needs no network carries within it: plotly, and JSON for its script."""

from __future__ import annotations

import base64
import gzip
import json
from functools import lru_cache
from importlib import resources
from typing import Any

__all__ = ["packed_plotly", "script_json"]


def script_json(value: Any) -> str:
    """Return JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


@lru_cache(maxsize=1)
def packed_plotly() -> str:
    """Return plotly.js, gzipped and in base64: a third of its size, and browsers unpack gzip by themselves."""
    source = resources.files("plotly").joinpath("package_data").joinpath("plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, 9, mtime=0)).decode("ascii")
