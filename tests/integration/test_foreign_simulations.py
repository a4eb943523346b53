"""Simulations that others wrote, in the simulator's place over real DDS: what goes wrong in them is a fault."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message
from pendulum_sim.exports.model_files import mjcf
from pendulum_testing.fmu import build_fmu
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram

pytest.importorskip("mujoco")


class Peer(PlantPeer):
    """Controller, listener and client of one simulator; hears the torques that it applies, too."""

    def __init__(self) -> None:
        super().__init__(torque=0.0)
        self.applied: list[float] = []
        self.node.create_subscription(
            JointState, names.APPLIED_EFFORT, lambda message: self.applied.append(message.effort[0]), qos.STATE
        )


@pytest.fixture
def peer(domain_id: int) -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


def start(processes: ProcessGroup, program: str, *parameters: str) -> RunningProgram:
    arguments = [item for parameter in parameters for item in ("-p", parameter)]
    return processes.start("pendulum_sim", program, "--ros-args", *arguments)


@pytest.mark.parametrize("kind", ["mujoco", "fmu"])
def test_two_lockstep_runs_of_a_model_file_give_the_same_messages(
    peer: Peer, processes: ProcessGroup, tmp_path: Path, kind: str
) -> None:
    model, mapping = tmp_path / "thesis.xml", tmp_path / "mapping.yaml"
    model.write_text(mjcf(load_plant("thesis")), encoding="utf-8")
    if kind == "fmu":
        pytest.importorskip("fmpy")
        pytest.importorskip("pythonfmu")
        model = build_fmu(tmp_path, 2)
    mapping.write_text("format: pendulum_simulation/1\neffort_limit: {value: 3.0, unit: N m}\n", encoding="utf-8")
    peer.torque = 1.0
    runs = []
    for _ in range(2):
        peer.states.clear()
        program = start(
            processes,
            kind,
            f"model:={model}",
            f"mapping:={mapping}",
            "clock:=lockstep",
            "lockstep_duration:=0.3",
            "start:=random",
            "seed:=4",
            "sensor.position_noise:=0.001",
        )
        peer.until(
            lambda: peer.states and stamp_from_message(peer.states[-1].header.stamp) >= 1.3e9, "the end of the run"
        )
        # A state that is not answered within a second comes twice, and says the same.
        runs.append(
            {(stamp_from_message(s.header.stamp), s.position[0], s.velocity[0], s.effort[0]) for s in peer.states}
        )
        program.interrupt()
        assert program.wait(10.0) == 0
        peer.until(lambda: peer.node.count_publishers(names.JOINT_STATES) == 0, "the plant to leave")
    assert len(runs[0]) == 151
    assert runs[0] == runs[1]


@pytest.mark.parametrize("clock", ["realtime", "lockstep"])
def test_a_model_that_blows_up_faults_with_a_sentence_until_it_is_reset(
    peer: Peer, processes: ProcessGroup, tmp_path: Path, clock: str
) -> None:
    model = tmp_path / "light.xml"
    # Explicit damping of 50 N m s/rad on 0.001 kg m^2 at 20 ms: unstable, as a wrong unit in a file makes it.
    model.write_text(
        '<mujoco><option timestep="0.02" integrator="RK4"/><worldbody><body><joint name="hinge" damping="50"/>'
        '<inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>'
        '<actuator><motor joint="hinge" ctrlrange="-5 5" ctrllimited="true"/></actuator></mujoco>',
        encoding="utf-8",
    )
    # Little enough to arm with; it goes on while nothing moves.
    peer.torque = 0.2
    program = start(processes, "mujoco", f"model:={model}", f"clock:={clock}")
    peer.until(lambda: peer.diagnostics.get("mode") == "fault", "the fault")
    assert "simulation light.xml: MuJoCo met a value that is not finite or too large" in peer.diagnostics["reason"]
    program.wait_for_output("is a timestep of 20 ms too long", 20.0)
    peer.until(lambda: peer.applied[-1] == 0.0, "zero torque")
    assert peer.arm(False).success
    refused = peer.arm(True)
    assert not refused.success
    assert refused.message.endswith("reset it first")
    count = len(peer.states)
    assert peer.ask("reset").success
    peer.until(lambda: len(peer.states) > count, "states after the reset")
    program.interrupt()
    assert program.wait(10.0) == 0


def test_a_model_that_is_refused_ends_with_one_sentence(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    program = start(processes, "mujoco", f"model:={tmp_path / 'none.xml'}")
    assert program.wait(30.0) == 2
    assert "none.xml does not exist; expected an MJCF or URDF file" in program.output
    assert "Traceback" not in program.output


_STUCK = """
import time
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv


class Stuck(PendulumEnv):
    def reset(self, **options):
        self.count = 0
        return super().reset(**options)

    def step(self, action):
        self.count += 1
        if self.count > {count}:
            {what}
        return super().step(action)


gymnasium.register("{name}", entry_point=Stuck)
"""
_ADAPTER = """
format: pendulum_simulation/1
angle: {index: 0, zero: 3.141592653589793}
velocity: {index: 1}
torque: {index: 0}
read: state
start: state
period: dt
effort_limit: max_torque
"""


def _environment(folder: Path, what: str) -> tuple[str, ...]:
    """Write an environment that does something odd after some steps; return the parameters that choose it."""
    # Runs that try it out are shorter.
    (folder / "lab_envs.py").write_text(_STUCK.format(what=what, name="Lab-v0", count=100), encoding="utf-8")
    adapter = folder / "adapter.yaml"
    adapter.write_text(_ADAPTER, encoding="utf-8")
    return "env:=lab_envs:Lab-v0", f"mapping:={adapter}"


def test_an_environment_that_stalls_ends_with_zero_torque_and_one_sentence(
    peer: Peer, processes: ProcessGroup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = _environment(tmp_path, "time.sleep(1000)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    peer.torque = 0.5
    program = start(processes, "gymnasium", *chosen, "step_timeout:=0.5")
    peer.until(lambda: program.returncode is not None, "the end of the program")
    assert program.returncode == 1
    assert "error: a step of simulation lab_envs:Lab-v0 did not come back within 0.5 s" in program.output
    peer.until(lambda: peer.applied[-1] == 0.0, "zero torque", 20.0)
    assert max(peer.applied) > 0.0


def test_an_environment_that_fails_is_a_fault_with_its_error(
    peer: Peer, processes: ProcessGroup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = _environment(tmp_path, "raise ValueError('the licence has expired')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    program = start(processes, "gymnasium", *chosen)
    peer.until(lambda: peer.diagnostics.get("mode") == "fault", "the fault")
    assert (
        peer.diagnostics["reason"] == "simulation lab_envs:Lab-v0 failed in step: ValueError: the licence has expired"
    )
    assert peer.states[-1].header.stamp.sec > 0
    program.interrupt()
    assert program.wait(10.0) == 0
