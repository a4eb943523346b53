"""The plant of a parameter file: rigid or series elastic."""

from __future__ import annotations

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.plant import Plant, RigidPlant
from pendulum_sim.stepping.series_elastic import SeriesElasticPlant

__all__ = ["make_plant"]


def make_plant(parameters: PlantParameters, dt: float, *, method: str = "auto", substeps: int | None = None) -> Plant:
    """Return the plant that the parameters describe, with commands held over dt [s].

    ``method`` is one of ``integrators.METHODS``; ``auto`` is ``etd4``, or for a series-elastic plant ``semi_implicit``,
    its only one. ``substeps`` None is 1, or for a series-elastic plant steps of at most 0.25 ms.

    Raises:
        ParameterError: The method does not fit the plant, or an argument is outside its domain.
    """
    if parameters.drivetrain is None:
        return RigidPlant(
            parameters, dt, method="etd4" if method == "auto" else method, substeps=1 if substeps is None else substeps
        )
    if method not in {"auto", "semi_implicit"}:
        raise ParameterError(
            f"method is {method!r}; expected semi_implicit or auto, since plant {parameters.name!r} is series elastic"
        )
    return SeriesElasticPlant(parameters, dt, substeps=substeps)
