"""Numbers of MuJoCo files: time to the same loss, and intervals that hold the truth, beside ``mujoco.sysid``.

Recordings are made by plain MuJoCo at the file's timestep, with the noise of the positions that a real double pendulum
at rest shows (8.5e-5 to 1.9e-4 rad). ``mujoco.sysid`` compares a sample with the sensors one step earlier, and ramps
between torques: it gets the state in place of sensors, a torque for each step, and the true start.
"""

from __future__ import annotations

import contextlib
import io
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pendulum_bags.identification.joint_fit import first_weights, fit, prepare_windows, scores
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.simulation_model import MujocoMotion, SimulationModel
from pendulum_bags.identification.simulation_result import identify_simulation
from pendulum_sim.foreign.model_source import ModelSource
from tests.benchmarks import Row, counted, measured, peer

__all__ = ["rows"]

NOISE = 1.5e-4
"""Standard deviation of an angle [rad]."""
SECONDS = 6.0
"""Length of a recording [s]."""
MODELS = int(os.environ.get("PENDULUM_SYSID_MODELS", "20"))
"""Perturbed models whose intervals are counted."""

HINGE = """<mujoco><option timestep="0.004"/><worldbody><body name="link">
<joint name="arm" axis="0 1 0" damping="{0}" frictionloss="{1}"/>
<inertial pos="0 0 -{3}" mass="0.6" diaginertia="{2} {2} 0.001"/></body></worldbody>
<actuator><motor name="motor" joint="arm"/></actuator><sensor><jointpos name="a" joint="arm"/></sensor></mujoco>"""
DOUBLE = """<mujoco><option timestep="0.004"/><worldbody><body name="link">
<joint name="arm" axis="0 1 0" damping="{0}"/>
<inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.02 0.02 0.001"/>
<body name="tip" pos="0 0 -0.4"><joint name="wrist" axis="0 1 0" damping="{1}"/>
<inertial pos="0 0 -{3}" mass="{4}" diaginertia="{2} {2} 0.001"/></body></body></worldbody>
<actuator><motor name="motor" joint="arm"/><motor name="second" joint="wrist"/></actuator>
<sensor><jointpos name="a" joint="arm"/><jointpos name="w" joint="wrist"/></sensor></mujoco>"""


@dataclass(frozen=True)
class _Task:
    """A file with some numbers: their paths and values, and how ``mujoco.sysid`` sets them."""

    name: str
    text: str
    paths: Sequence[str]
    values: Sequence[float]
    torque: float
    window: float

    def set(self, spec: Any, path: str, value: float) -> None:
        """Write one number into MuJoCo's specification."""
        kind, owner, attribute = path.split("/")
        element = getattr(spec, kind)(owner)
        if attribute == "ipos":
            element.ipos = [0.0, 0.0, -value]
        elif attribute == "inertia":
            element.inertia = [value, value, 0.001]
        elif attribute == "damping":
            element.damping[0] = value
        else:
            setattr(element, attribute, value)


TASKS = (
    _Task(
        "one hinge",
        HINGE,
        ("joint/arm/damping", "joint/arm/frictionloss", "body/link/inertia", "body/link/ipos"),
        (0.08, 0.05, 0.02, 0.4),
        2.5,
        1.0,
    ),
    _Task(
        "double pendulum",
        DOUBLE,
        ("joint/arm/damping", "joint/wrist/damping", "body/tip/inertia", "body/tip/ipos", "body/tip/mass"),
        (0.08, 0.03, 0.01, 0.2, 0.3),
        0.6,
        1.0,
    ),
)


def rows() -> Iterator[Row]:
    """Yield time to the same loss of both files, and the counts of intervals of the double pendulum."""
    for task in TASKS:
        case = _Case(task, 1)
        ours, what = case.fitted(), f"fit {len(task.paths)} numbers of {task.name}, {SECONDS:g} s"

        def theirs(case: _Case = case, ours: SimulationModel = ours) -> float:
            took, values, _ = case.by_sysid()
            found = ours.with_changes(dict(zip(case.task.paths, values, strict=True)))
            assert case.loss(ours) < 1.01 * case.loss(found)
            return 1.0 / took

        best = 1.0 / min(case.time_to_fit() for _ in range(3))
        yield measured(what, best, "fits/s", peer=peer("mujoco.sysid", theirs))
    cases = [_Case(TASKS[1], 100 + seed) for seed in range(MODELS)]
    every, what = MODELS * len(TASKS[1].paths), f"intervals that hold the truth, {MODELS} double pendulums"
    yield counted(f"{what}: ours", sum(case.held_by_ours() for case in cases), every, at_least=90.0)
    theirs_too = peer("mujoco.sysid", lambda: float(sum(case.held_by_sysid() for case in cases)))
    if theirs_too.value is not None:
        yield counted(f"{what}: mujoco.sysid", int(theirs_too.value), every)


class _Case:
    """A file whose numbers are 30 % off at most, and a recording of the true one."""

    def __init__(self, task: _Task, seed: int) -> None:
        import mujoco

        self.task, rng = task, np.random.default_rng(seed)
        self.true = np.array(task.values) * rng.uniform(0.7, 1.3, len(task.values))
        with TemporaryDirectory() as folder:
            path = Path(folder) / "start.xml"
            path.write_text(task.text.format(*task.values), encoding="utf-8")
            self.motion = MujocoMotion(ModelSource(path))
        model = mujoco.MjModel.from_xml_string(task.text.format(*self.true))
        data, step = mujoco.MjData(model), float(model.opt.timestep)
        count = round(SECONDS / step)
        effort = np.repeat(rng.uniform(-task.torque, task.torque, (count // 25 + 1, model.nu)), 25, axis=0)[:count]
        data.qpos[:] = 0.5
        position = np.empty((count, model.nq))
        for k in range(count):
            position[k] = data.qpos
            data.ctrl[:] = effort[k]
            mujoco.mj_step(model, data)
        position = np.asarray(position + NOISE * rng.standard_normal(position.shape), dtype=np.float64)
        times = np.asarray(step * np.arange(count), dtype=np.float64)
        self.recording = JointRecording(task.name, times, position, effort, ("zero",) * model.nq)
        self.data = [prepare_windows(self.recording, task.window)]

    @property
    def start(self) -> SimulationModel:
        """The file's numbers."""
        return SimulationModel.of(self.motion, [self.motion.source.parameter(path) for path in self.task.paths])

    def fitted(self) -> SimulationModel:
        """Return the fit from the file's numbers."""
        vector = fit(self.start, self.data, self.task.paths, first_weights(self.data)).model.vector
        return self.start.with_vector(vector)

    def time_to_fit(self) -> float:
        """Return how long that takes [s]."""
        self.motion.forget()
        begin = time.perf_counter()
        self.fitted()
        return time.perf_counter() - begin

    def loss(self, model: SimulationModel) -> float:
        """Return the rms error over the windows, their starts fitted [rad]."""
        return float(np.linalg.norm(scores(model, self.data)[0].rms))

    def held_by_ours(self) -> int:
        """Return how many of our intervals hold the truth."""
        found = identify_simulation(self.motion, [self.recording], dict.fromkeys(self.task.paths)).intervals
        ends = [(found[path].low, found[path].high) for path in self.task.paths]
        return sum(low <= true <= high for (low, high), true in zip(ends, self.true, strict=True))

    def held_by_sysid(self) -> int:
        """Return how many intervals of ``mujoco.sysid`` do."""
        _, values, half = self.by_sysid()
        return int(np.sum(np.abs(values - self.true) <= half))

    def by_sysid(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Return how long ``mujoco.sysid`` takes [s], what it finds and the half widths of its 95 % intervals."""
        import mujoco
        from mujoco import sysid

        spec, one = mujoco.MjSpec.from_string(self.task.text.format(*self.task.values)), self.recording
        model, parameters = spec.compile(), sysid.ParameterDict()
        for path, value in zip(self.task.paths, self.task.values, strict=True):

            def change(s: Any, p: Any, path: str = path) -> None:
                self.task.set(s, path, float(p.value[0]))

            parameters.add(sysid.Parameter(path, value, 0.3 * value, 3.0 * value, modifier=change))
        names = [(f"{joint}_qpos", sysid.SignalType.MjStateQPos) for joint in self.motion.coordinates.names]
        if len(names) == 1:
            names = [("arm_qpos", sysid.SignalType.MjStateQPos)]
        run = sysid.ModelSequences(
            "task", spec, "run", sysid.create_initial_state(model, np.full(model.nq, 0.5)),
            sysid.TimeSeries.from_control_names(one.time, one.effort, model),
            sysid.TimeSeries.from_names(one.time, one.position, model, names=names),
        )  # fmt: skip
        residual = sysid.build_residual_fn(models_sequences=[run], n_threads=len(os.sched_getaffinity(0)))
        begin = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            found, result = sysid.optimize(parameters, residual, verbose=False)
        took = time.perf_counter() - begin
        half = sysid.calculate_intervals(residual(result.x, found)[0], result.jac)[1]
        return took, np.asarray(result.x), np.asarray(half)
