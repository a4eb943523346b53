"""A plant file for an exercise: simulators run it, but its parameters are not readable.

The seal is packing, not encryption: it prevents a student from seeing the solution by accident.
"""

from __future__ import annotations

import base64
import binascii
import json
import zlib
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import dump_yaml, load_yaml, reject_unknown, require_mapping
from pendulum_msgs_py.plants.plant_parameters import (
    SEALED_FORMAT,
    PlantParameters,
    load_mechanism,
    plant_document,
    read_plant_document,
    resolve_plant,
)

__all__ = ["load_plant_to_run", "seal_plant"]


def seal_plant(parameters: PlantParameters) -> str:
    """Return the text of a sealed plant file."""
    packed = zlib.compress(json.dumps(plant_document(parameters)).encode(), 9)
    document = {"format": SEALED_FORMAT, "name": parameters.name, "sealed": base64.b64encode(packed).decode("ascii")}
    return dump_yaml(document, "sealed plant file")


def load_plant_to_run(preset_or_path: str | Path) -> tuple[PlantParameters, bool]:
    """Return the plant of a preset or file, and whether it is sealed, so that its values must not be shown.

    Raises:
        ParameterError: It does not exist, is refused, or its seal is damaged.
    """
    path = resolve_plant(preset_or_path)
    document = load_yaml(path, "plant file")
    if document.get("format") != SEALED_FORMAT:
        return load_mechanism(path), False
    reject_unknown(document, ("format", "name", "sealed"), where=str(path))
    try:
        packed = base64.b64decode(str(document.get("sealed")), validate=True)
        content = require_mapping(json.loads(zlib.decompress(packed)), f"sealed plant of {path}")
    except (binascii.Error, zlib.error, ValueError) as error:
        raise ParameterError(f"sealed plant file {path} is damaged; expected it as the course wrote it") from error
    return read_plant_document(content, path)[0], True
