"""Reads a model file with MuJoCo, meshes of a ROS description included."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import xacro_hint
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = ["import_mujoco", "read_model"]

_PACKAGE = "package://"


def import_mujoco() -> Any:
    """Return the module; a ParameterError says how to install it."""
    # Imported late: it takes 60 MB.
    try:
        import mujoco
    except ImportError as error:
        raise ParameterError(how_to_install(error) or f"MuJoCo cannot be imported: {error}") from error
    # It would write warnings to a file in the working folder; they are raised here as errors.
    mujoco.set_mju_user_warning(lambda _text: None)
    return mujoco


def read_model(
    mujoco: Any, path: Path, text: str | None = None, included: Mapping[str, bytes] | None = None
) -> tuple[Any, list[str]]:
    """Return the compiled model and remarks on omitted meshes; a ParameterError if there is none or MuJoCo refuses it.

    ``text`` takes the place of the file's, and ``included``, by name, that of the files that it includes.
    """
    if text is None and not path.is_file():
        raise ParameterError(f"model {path} does not exist; expected an MJCF or URDF file")
    text = path.read_text(encoding="utf-8", errors="replace") if text is None else text
    if hint := xacro_hint(path, text):
        raise ParameterError(f"model {path} is no model yet: {hint}")
    remarks: list[str] = []
    try:
        if included is None:
            spec = mujoco.MjSpec.from_file(str(path))
        else:
            spec = mujoco.MjSpec.from_string(text, include=dict(included))
            spec.modelfiledir = str(path.resolve().parent)
        for mesh in list(spec.meshes) if "<robot" in text else ():
            found = _find(str(mesh.file), path)
            if found is not None and (problem := _problem(mujoco, found)) == "":
                mesh.file = str(found)
                continue
            # A mesh has no effect on a link with given inertia; MuJoCo reports a link without.
            for geom in [geom for geom in spec.geoms if geom.meshname == mesh.name]:
                spec.delete(geom)
            why = "no such file" if found is None else problem
            remarks.append(f"mesh {mesh.file} is left out, so its link touches nothing ({why})")
            spec.delete(mesh)
        return spec.compile(), remarks
    except ValueError as error:
        raise ParameterError(f"MuJoCo refuses model {path}: {' '.join(str(error).split())}") from error


def _find(name: str, path: Path) -> Path | None:
    """Return the file of a mesh: by its path, or in the package that contains the model or lies next to it."""
    folders = path.resolve().parents
    if name.startswith(_PACKAGE):
        inside = Path(name.removeprefix(_PACKAGE))
        places = [place for folder in folders for place in (folder / Path(*inside.parts[1:]), folder / inside)]
    else:
        places = [folders[0] / name.removeprefix("file://")]
    return next((place for place in places if place.is_file()), None)


def _problem(mujoco: Any, mesh: Path) -> str:
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=str(mesh))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        spec.compile()
    except ValueError as error:
        return str(error).splitlines()[0].removeprefix("Error: ")
    return ""
