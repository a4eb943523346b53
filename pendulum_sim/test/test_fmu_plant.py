"""FMUs of FMI 2 and 3 as plants: built here from Python, run by FMPy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from pendulum_msgs_py.errors import FaultError, ParameterError

pytest.importorskip("fmpy")
pytest.importorskip("pythonfmu")
pytest.importorskip("pythonfmu3")

from pendulum_sim.foreign.fmu_environment import load_fmu_mapping, load_fmu_plant
from pendulum_sim.simulator.engines import open_simulation
from pendulum_testing.fmu import build_fmu

MAPPING = "format: pendulum_simulation/1\neffort_limit: {value: 3.0, unit: N m}\n"


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI 2", "FMI 3"])
def unit(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(tmp_path_factory.mktemp("fmu"), request.param)


def mapped(folder: Path, text: str = "equation: thesis\n") -> Path:
    path = folder / "mapping.yaml"
    path.write_text(MAPPING + text)
    return path


def test_a_unit_moves_as_its_equation_and_is_checked_against_it(unit: Path, tmp_path: Path) -> None:
    simulation = open_simulation(str(unit), str(mapped(tmp_path, "")))
    found = simulation.plant.parameters
    assert found.inertia == pytest.approx(0.125, rel=0.01)
    assert found.damping == pytest.approx(0.3, rel=0.02)
    assert found.gravity == pytest.approx(2.0, rel=0.01)
    assert simulation.method.startswith(f"fmi {unit.stem[-1]}.0, fmpy")
    assert simulation.check is not None
    assert simulation.check().agrees


def test_an_effort_is_held_for_a_period_and_start_values_count(unit: Path, tmp_path: Path) -> None:
    plant = load_fmu_plant(unit, load_fmu_mapping(mapped(tmp_path, "values: {damping: 0.5}\nequation: thesis\n")))
    assert plant.dt == 0.002
    plant.reset(0.3, 1.0)
    theta, speed = 0.3, 1.0
    for _ in range(500):
        state = plant.step(0.4)
        for _ in range(4):
            speed += 0.0005 * (0.4 - 0.5 * speed - 2.0 * math.sin(theta)) / 0.125
            theta += 0.0005 * speed
    np.testing.assert_allclose([state.theta, state.theta_dot], [theta, speed], rtol=1e-12)
    assert state.time == pytest.approx(1.0)


def test_points_in_time_are_rounded_not_truncated(unit: Path, tmp_path: Path) -> None:
    # 1/300 s is no whole number of nanoseconds; the unit itself refuses a point that is off.
    text = "period: {value: 0.0033333333333, unit: s}\nequation: thesis\n"
    plant = load_fmu_plant(unit, load_fmu_mapping(mapped(tmp_path, text)))
    plant.reset(0.1, 0.0)
    for _ in range(400):
        plant.step(0.0)


def test_a_unit_that_ends_is_a_fault(unit: Path, tmp_path: Path) -> None:
    simulation = open_simulation(str(unit), str(mapped(tmp_path)))
    simulation.plant.reset((49.9999,), (100.0,))
    with pytest.raises(FaultError, match=unit.name):
        simulation.plant.step((0.0,), (0.0,))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("velocity: {variable: omega}\n", "has no number 'omega' for velocity"),
        ("values: {mass: 1.0}\n", "has no start value 'mass'; expected one of: .*damping"),
        ("start: theta\n", "expected two names"),
        ("period: 0.002\n", "period"),
        ("values: {damping: much}\n", "damping is 'much'; expected a number"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused(unit: Path, tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        open_simulation(str(unit), str(mapped(tmp_path, text)))


def test_what_is_no_unit_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.fmu").write_text("no archive")
    for path, said in ((tmp_path / "text.fmu", "FMPy refuses"), (tmp_path / "none.fmu", "does not exist")):
        with pytest.raises(ParameterError, match=said):
            open_simulation(str(path))
