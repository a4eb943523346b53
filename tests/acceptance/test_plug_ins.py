"""What a stranger adds, with one file or function and one line each, is there at once: in help, tables and runs."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pendulum_rosbag.reader import read_bag
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.synthetic_runs import write_run_folder

PACKAGES = (
    "pendulum_msgs_py/pendulum_msgs_py",
    "pendulum_sim/pendulum_sim",
    "pendulum_lqr/pendulum_lqr",
    "pendulum_hw_bridge/pendulum_hw_bridge",
    "bags/pendulum_rosbag/pendulum_rosbag",
    "bags/pendulum_bags/pendulum_bags",
    "bags/pendulum_console/pendulum_console",
    "bags/pendulum_learning/pendulum_learning",
    "bags/pendulum_course/pendulum_course",
)

FILES = {
    "pendulum_lqr/controllers/springy.py": """
from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_msgs_py.parameters import ParameterSpec


class Springy(BaseController):
    SUMMARY = "A spring and nothing else."
    PARAMETERS = (ParameterSpec("spring", 30.0, "N m/rad", "How hard it pulls.", minimum=0.0),)

    def __init__(self, spring, effort_limit, set_point):
        super().__init__(effort_limit, set_point)
        self.spring = spring

    @classmethod
    def design(cls, plant, period, p):
        return cls(p["spring"], p["effort_limit"], p["set_point"])

    def command(self, t, x):
        return self.clamp(-self.spring * self.error(x[0]))
""",
    "pendulum_msgs_py/plants/presets/heavy.yaml": """
format: pendulum_plant/1
name: heavy
parameters:
  inertia: {value: 0.2, unit: kg m^2}
  damping: {value: 8.0, unit: N m s/rad}
  gravity: {value: 4.0, unit: N m}
""",
    "pendulum_hw_bridge/backends/toy.py": """
from pendulum_hw_bridge.backends.emulator import EmulatorBackend


class ToyBackend(EmulatorBackend):
    name = "toy"
""",
    "pendulum_bags/analyse/questions/length.py": """
from pendulum_rosbag.reader import read_bag


def answer(path, plant):
    with read_bag(path) as bag:
        return {"states": len(bag.array(f"{plant}/joint_states"))}
""",
}
"""Files of a stranger, beside ours."""

FUNCTIONS = {
    "pendulum_lqr/disturbances/disturbance.py": (
        "DISTURBANCES",
        """
def _square_wave(p, hold_ns):
    period = 1e9 / p["frequency"]
    return lambda t: 0.0 if t < 0 else p["amplitude"] if t % period < p["duty"] * period else -p["amplitude"]
""",
    ),
    "pendulum_msgs_py/plants/friction_terms.py": (
        "FRICTION_TERMS",
        """
def _drag(speed, weight, drag, drag_exponent):
    return drag * speed**drag_exponent
""",
    ),
    "pendulum_bags/comparison/metrics.py": (
        "METRICS",
        """
def _crossings(episode):
    return float(sum(a * b < 0.0 for a, b in zip(episode.error, episode.error[1:])))
""",
    ),
    "pendulum_bags/report/figures.py": (
        "FIGURES",
        """
def first_figure(data):
    import numpy as np
    from pendulum_bags.figures.figure import Figure, Panel, Trace

    panel = Panel("time [s]", "runs [-]", [Trace(np.zeros(2), np.ones(2), "runs", "sim")])
    return Figure("first", "A first figure", f"Made of {len(data.names)} runs.", [panel], section="A new section")
""",
    ),
}
"""Functions of a stranger: the file, the table that they stand before, the function."""

LINES = {
    "pendulum_msgs_py/plants/friction_terms.py": (
        "FRICTION_TERMS",
        """"drag": FrictionTerm(_drag, {
            "drag": (0.0, Quantity("N m", "Drag of the air at 1 rad/s.")),
            "drag_exponent": (2.0, Quantity("-", "How it grows with the speed.", positive=True)),
        }),""",
    ),
    "pendulum_lqr/controller_interface/controller.py": (
        "CONTROLLERS",
        '"springy": Row("pendulum_lqr.controllers.springy:Springy"),',
    ),
    "pendulum_hw_bridge/backends/__init__.py": (
        "BACKENDS",
        '"toy": Backend("pendulum_hw_bridge.backends.toy:ToyBackend", _fixed("colour", "red", "`toy`: its colour.")),',
    ),
    "pendulum_bags/analyse/questions/__init__.py": (
        "QUESTIONS",
        '"length": Question("pendulum_bags.analyse.questions.length"),',
    ),
    "pendulum_lqr/disturbances/disturbance.py": (
        "DISTURBANCES",
        '"square_wave": DisturbanceKind(_square_wave, parameters=(ParameterSpec("duty", 0.5, "-", "Its share."),)),',
    ),
    "pendulum_bags/comparison/metrics.py": ("METRICS", 'Metric("crossings", "-", "changes of sign", _crossings),'),
    "pendulum_bags/report/figures.py": ("FIGURES", '("A first figure", first_figure),'),
}
"""The line that each adds to a table; a preset needs none."""

DRAGGED = """
format: pendulum_plant/1
name: dragged
parameters:
  inertia: {value: 0.5, unit: kg m^2}
  damping: {value: 0.0, unit: N m s/rad}
  gravity: {value: 0.0, unit: N m}
  drag: {value: 0.25, unit: N m}
"""
"""A plant file of theirs, whose parameter is that of their friction term."""

LOOK = """
import contextlib, io, json, sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from pendulum_bags.commands.analyse_cli import main as analyse
from pendulum_bags.comparison import compare_folders
from pendulum_bags.comparison.metrics import Episode, metrics_of
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.commands.identify_cli import main as identify
from pendulum_bags.identification.kernel import PARAMETER_NAMES, _derivatives_of_terms
from pendulum_bags.identification.model import from_plant, to_plant
from pendulum_bags.report import write_report
from pendulum_hw_bridge.port.actuator import HardwareLimits
from pendulum_hw_bridge.nodes.bridge_node import main as bridge
from pendulum_hw_bridge.bridge.bridge_consistency import check_consistency
from pendulum_hw_bridge.bridge.bridge_parameters import make_port
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.emulation.kernel import STATES, STEP, advance
from pendulum_hw_bridge.emulation.parameters import EmulatorParameters
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_lqr.controller_interface.controller import controller_parameters
from pendulum_lqr.nodes.controller_node import main as controller
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS
from pendulum_lqr.disturbances.disturbance_node import main as disturbance
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.parameters import markdown_table, validate
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, load_plant
from pendulum_sim.stepping.mechanism_plant import is_smooth
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_sim.stepping.series_elastic import pack_series_elastic, series_elastic_step
from pendulum_sim.simulator.simulator_node import main as simulator

bag, run, out, dragged = sys.argv[1:]


def said(main, *arguments):
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main(list(arguments))
    return " ".join(text.getvalue().split())


def refused(call, *arguments):
    try:
        call(*arguments)
    except PendulumError as error:
        return str(error)
    return ""


def with_drag():
    # What a drag does in each place that has an equation of its own.
    plant = load_plant(dragged)
    free = make_pendulum(plant, 0.01, method="rk4")
    free.reset(0.0, 4.0)
    speeds = [free.step(0.0).theta_dot for _ in range(100)]
    geared = load_plant("x5_9")
    steps = []
    for own in (geared, geared.with_values(drag=plant.drag)):
        link = (0.0, 0.0, 0.0, 2.0, 0.0)
        (_, _, _, elastic, _) = series_elastic_step(*link, 0.0, 0.0, STEP, pack_series_elastic(own))
        state = np.zeros(len(STATES))
        state[STATES.index("velocity")] = 2.0
        constants = EmulatorParameters(own).constants(HardwareLimits(effort=13.0), 36.0, True)
        # Interpreted: the machine code, which is made of this, would take seconds.
        advance(state, constants, np.zeros((3, 14)), np.zeros((3, 5)), np.full(3, np.nan), 1, 0.0, 1, 1)
        steps.append([elastic, state[STATES.index("velocity")]])
    model = from_plant(plant)
    slopes = np.zeros(len(PARAMETER_NAMES))
    slopes_of = _derivatives_of_terms(3.0, 0.5, model.vector, slopes)
    return {
        "table": markdown_table(PLANT_SPECS), "speeds": speeds, "steps": steps, "inertia": geared.inertia,
        "kept": to_plant(model).drag, "slopes": [*slopes_of, *slopes[[*map(PARAMETER_NAMES.index, plant_terms)]]],
        "wrong": refused(lambda: plant.with_values(drag=-1.0)), "dry": is_smooth(plant),
    }


plant_terms = ("drag", "drag_exponent")
spec = RunSpec(
    plant="heavy", design_plant="heavy", controller="springy", duration=1.0,
    disturbance={"kind": "square_wave", "duty": 0.25, "frequency": 2.0, "amplitude": 1.5},
)
arrays = simulate(spec)
values = {**validate(SPECS, {"backend": "toy", "starvation_limit": 5.0}), "clock": "realtime"}
page = write_report(out, comparison=compare_folders([run]), recordings=[], formats=()).read_text()
print(json.dumps({
    "help": {
        "controller": said(controller, "--help"), "disturbance": said(disturbance, "--help"),
        "simulator": said(simulator, "--help"), "bridge": said(bridge, "--help"), "analyse": said(analyse, "--help"),
        "identify": said(identify, "--help"),
    },
    "tables": {
        "controller": markdown_table(controller_parameters("springy")),
        "disturbance": markdown_table(DISTURBANCE_SPECS), "bridge": markdown_table(SPECS),
    },
    "command": arrays.command.tolist(),
    "position": arrays.position.tolist(),
    "torques": sorted(set(arrays.disturbance.tolist())),
    "backend": make_port(values, SteppedClock()).connect().backend,
    "slack": refused(check_consistency, values | {"command_lifetime": 0.5}, PlantLimits((13.0,))),
    "metrics": metrics_of(Episode(arrays.stamp_ns * 1e-9, arrays.position - 3.2, arrays.position, arrays.effort)),
    "answers": json.loads(said(analyse, bag, "--ask", "length", "--json", "--out", out)),
    "page": page[page.index("</style>"):][-4_000_000:],
    "drag": with_drag(),
}))
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what a copy of the packages with one of each shows; all are asked at once, since imports take seconds."""
    folder = tmp_path_factory.mktemp("plug_ins")
    # With modules that Python has compiled, which it knows by their time; what numba has is made of other source.
    ignored = shutil.ignore_patterns("*.nb?", "*.loop", "*.lock")
    for package in PACKAGES:
        shutil.copytree(PROJECT / package, folder / Path(package).name, ignore=ignored)
    for name, text in FILES.items():
        (folder / name).write_text(text.lstrip(), encoding="utf-8")
    for name, (table, function) in FUNCTIONS.items():
        _edit(folder / name, rf"^{table}\b", lambda found, function=function: f"{function}\n\n{found.group()}")
    for name, (table, line) in LINES.items():
        _edit(folder / name, rf"^{table}\b.*= [{{(]\n", lambda found, line=line: f"{found.group()}    {line}\n")
    (folder / "dragged.yaml").write_text(DRAGGED.lstrip(), encoding="utf-8")
    write_run_folder(folder / "run", seed=1)
    command = [sys.executable, "-c", LOOK, *(str(folder / name) for name in ("run/sim", "run", "out", "dragged.yaml"))]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    states = len(read_bag(folder / "run" / "sim").array("/sim/joint_states"))
    return {**json.loads(done.stdout), "states": states}


def _edit(path: Path, pattern: str, replace: Any) -> None:
    text, count = re.subn(pattern, replace, path.read_text(encoding="utf-8"), count=1, flags=re.MULTILINE)
    assert count == 1, (path, pattern)
    path.write_text(text, encoding="utf-8")


def test_a_new_controller_has_its_parameters_and_controls(seen: dict[str, Any]) -> None:
    assert "springy" in seen["help"]["controller"]
    assert "| `spring` | `30.0` N m/rad; >= 0 | How hard it pulls. |" in seen["tables"]["controller"]
    expected = [30.0 * (3.141592653589793 - angle) for angle in seen["position"]]
    assert seen["command"] == pytest.approx(expected)


def test_a_new_preset_is_listed_and_runs(seen: dict[str, Any]) -> None:
    for program in ("controller", "simulator"):
        assert re.search(r"\bheavy\b", seen["help"][program]), program
    # From rest upright, 1.5 N m on 0.2 kg m^2 for the first step of 2 ms that any torque acts in.
    start, moved = seen["position"][1:3]
    assert (moved - start) / 0.002**2 == pytest.approx(1.5 / 0.2, rel=1e-3)


def test_a_new_disturbance_has_its_parameters_and_pushes(seen: dict[str, Any]) -> None:
    assert "square_wave" in seen["help"]["disturbance"]
    assert "duty" in seen["help"]["disturbance"]
    assert "| `duty` | `0.5` | Its share. |" in seen["tables"]["disturbance"]
    assert seen["torques"] == [-1.5, 1.5]


def test_a_new_backend_has_its_parameters_connects_and_keeps_the_limits_of_a_machine(seen: dict[str, Any]) -> None:
    assert re.search(r"\btoy\b", seen["help"]["bridge"])
    assert "| `colour`* | `red` | `toy`: its colour. |" in seen["tables"]["bridge"]
    assert seen["backend"] == "toy"
    assert "so long a dead bridge drives" in seen["slack"]


def test_a_new_friction_term_has_its_parameters_and_slows_simulations_the_emulated_machine_and_the_fit(
    seen: dict[str, Any],
) -> None:
    told = seen["drag"]
    assert "| `drag` | `0.0` N m; >= 0 | Drag of the air at 1 rad/s. |" in told["table"]
    assert "| `drag_exponent` | `2.0`; > 0 | How it grows with the speed. |" in told["table"]
    assert told["wrong"] == "drag is -1.0 N m; expected >= 0"
    assert re.search(r"gear_load, drag, ", seen["help"]["identify"])
    # M v' = -c v^2 has the solution v_0 / (1 + c v_0 t / M).
    expected = [4.0 / (1.0 + 0.25 * 4.0 * 0.01 * k / 0.5) for k in range(1, 101)]
    assert told["speeds"] == pytest.approx(expected, rel=1e-6)
    # What needs a smooth equation does not take it for one.
    assert told["dry"] is False
    # Series elastic and emulated: in one step of 0.25 ms it takes c v^2 h / M from the link that it had left before.
    without, with_drag = told["steps"]
    assert [a - b for a, b in zip(without, with_drag, strict=True)] == pytest.approx(
        [0.25 * 2.0**2 * 2.5e-4 / told["inertia"]] * 2, rel=1e-9
    )
    # Fitted: by speed, by weight, by c, by the exponent at 3 rad/s; and back into a plant file.
    assert told["slopes"] == pytest.approx([0.25 * 2.0 * 3.0, 0.0, 9.0, 0.25 * 9.0 * math.log(3.0)], abs=1e-12)
    assert told["kept"] == 0.25


def test_a_new_question_is_listed_and_answered(seen: dict[str, Any]) -> None:
    assert re.search(r"\blength\b", seen["help"]["analyse"])
    assert [row["states"] for row in seen["answers"]["bags"]] == [seen["states"]]


def test_a_new_metric_is_measured(seen: dict[str, Any]) -> None:
    assert seen["metrics"]["crossings"] >= 0.0


def test_a_new_figure_is_drawn_in_a_section_of_its_own(seen: dict[str, Any]) -> None:
    assert "A new section" in seen["page"]
    assert "Made of 1 runs." in seen["page"]
