"""Numbers of a MuJoCo file are identified from recordings that plain MuJoCo made, and written back into the file."""

import json
from dataclasses import replace

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from pendulum_bags.commands import identify_cli  # noqa: E402
from pendulum_bags.identification.joint_recordings import JointRecording  # noqa: E402
from pendulum_bags.identification.simulation_model import MujocoMotion, SimulationModel, between_steps  # noqa: E402
from pendulum_bags.identification.simulation_result import (  # noqa: E402
    identifiability,
    identify_simulation,
    undetermined_numbers,
)
from pendulum_msgs_py.errors import DataError  # noqa: E402
from pendulum_sim.foreign.model_source import ModelSource  # noqa: E402

ARM = """<mujoco model="arm">
  <option timestep="0.004"/>
  <worldbody>
    <body name="link">
      <joint name="arm" axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="0.01"/> <!-- geared -->
      <inertial pos="0 0 -{distance}" mass="0.6" diaginertia="{inertia} {inertia} 0.001"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="arm" ctrlrange="-3 3"/></actuator>
</mujoco>
"""
TRUE = {"damping": 0.06, "friction": 0.05, "distance": 0.45, "inertia": 0.026}
START = {"damping": 0.1, "friction": 0.02, "distance": 0.4, "inertia": 0.02}
PATHS = {
    "joint/arm/damping": 0.06, "joint/arm/frictionloss": 0.05, "body/link/ipos": 0.45, "body/link/inertia": 0.026,
}  # fmt: skip
NOISE = 3e-4


def swing(seed, values=TRUE, *, seconds=8.0, offset=0.0, late=0, zero=0.0, quiet=0, text=ARM):
    """Return a recording of a file, made by plain MuJoCo."""
    model = mujoco.MjModel.from_xml_string(text.format(**values))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    count = round(seconds / model.opt.timestep)
    effort = np.repeat(rng.uniform(-2.5, 2.5, (count // 25 + 1, model.nu)), 25, axis=0)[:count]
    effort[:quiet] = 0.0
    data.qpos[:] = 0.5
    position = np.empty((count, model.nq))
    for k in range(count):
        position[k] = data.qpos
        data.ctrl[:] = effort[max(k - late, 0)] + offset
        mujoco.mj_step(model, data)
    position += zero + NOISE * rng.standard_normal(position.shape)
    time = model.opt.timestep * np.arange(count)
    return JointRecording(f"run{seed}", time, position, effort, ("zero",) * model.nq)


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(ARM.format(**START))
    return MujocoMotion(ModelSource(path))


def test_the_command_finds_the_numbers_and_writes_the_file_back(tmp_path, capsys):
    for seed in (1, 2):
        one = swing(seed)
        table = np.column_stack((one.time, one.position, one.effort))
        np.savetxt(tmp_path / f"{seed}.csv", table, delimiter=",", header="time,position,torque", comments="")
    model, out = tmp_path / "arm.xml", tmp_path / "new.xml"
    model.write_text(ARM.format(**START))
    data = [str(tmp_path / "1.csv"), "--held-out", str(tmp_path / "2.csv")]
    assert identify_cli.main([*data, "--model", str(model), "--out", str(tmp_path / "new.urdf")]) == 2
    assert "expected a name that ends in .xml" in capsys.readouterr().err
    assert identify_cli.main([*data, "--model", str(model)]) == 0
    assert "if it is a command that is held until the next one" in " ".join(capsys.readouterr().out.split())
    assert identify_cli.main([*data, "--model", str(model), "--hold", "zero", "--out", str(out)]) == 0

    said = capsys.readouterr().out
    assert "after its stamp" not in said
    assert "held: does the same as body/link/inertia" in said
    assert f"experiment thesis --simulation {out}" in " ".join(said.split())
    found = json.loads(out.with_suffix(".json").read_text())
    assert set(PATHS) <= set(found["fitted"])
    written = ModelSource(out)
    for name, true in PATHS.items():
        one = found["intervals"][name]
        assert abs(one["value"] - true) < 4.0 * one["standard_error"] < 0.05 * true
        assert written.parameter(name).value == pytest.approx(one["value"], rel=1e-6)
    assert found["held_out"]["2.csv"]["window_rms"] < 1.1 * NOISE
    before, after = model.read_text().splitlines(), out.read_text().splitlines()
    assert after[-len(before) :][:4] == before[:4]
    assert "(was 0.02, 95 % interval" in out.read_text()


def test_offset_and_delay_of_the_recording_are_not_put_into_the_file(motion):
    result = identify_simulation(motion, [swing(3, offset=0.15, late=2)], dict.fromkeys(PATHS))
    assert result.choice == "friction, offsets, delay"
    assert result.model["pendulum_joint.effort_offset"] == pytest.approx(0.15, abs=0.005)
    assert result.model["delay"] == pytest.approx(0.008, abs=5e-4)
    for name, true in PATHS.items():
        assert result.model[name] == pytest.approx(true, rel=0.03)
    assert any("the file does not get that" in one for one in result.sentences())


def test_two_machines_are_told_apart_and_two_zeros_are_not_two_machines(motion):
    names = {"body/link/ipos": None, "joint/arm/damping": None}
    known = {**START, "damping": 0.06, "distance": 0.45}
    first, heavier = swing(4, known, seconds=4.0), swing(5, {**known, "distance": 0.6}, seconds=4.0)
    tared = swing(6, known, seconds=4.0, zero=0.05)
    result = identify_simulation(motion, [first, tared], names, extras="friction")
    assert result.excluding is None
    assert result.fit.own == ("pendulum_joint.angle_offset",)
    assert float(np.ptp(result.fit.offsets)) == pytest.approx(0.05, abs=0.003)
    two = identify_simulation(motion, [first, heavier], names, extras="friction")
    assert "exclude each other" in " ".join(two.sentences())


def test_what_has_no_effect_or_the_effect_of_another_is_held(motion):
    names = ("body/link/inertia", "joint/arm/armature", "body/link/inertia/z", "body/link/ipos", "body/link/mass")
    wanted = (*names, "joint/arm/frictionloss")
    model = SimulationModel.of(motion, [motion.source.parameter(name) for name in wanted])
    shown = identifiability(model, [swing(22)], 2.0, propose=False)
    assert shown.chosen == (True, False, False, True, False, True)
    assert shown.together[4] > 0.5  # kg; where friction sticks, differences over a large step show it to 1 g
    assert shown.same["joint/arm/armature"] == "held: does the same as body/link/inertia"
    assert shown.same["body/link/inertia/z"] == "no effect on what was recorded: held"


def test_predicted_errors_are_those_of_many_recordings(motion):
    # Each fit begins at the truth, so that what differs is the noise; 12 runs know a spread to a fifth.
    clean, wanted, runs = swing(20, START, seconds=3.0), {"body/link/ipos": None, "joint/arm/damping": None}, []
    for seed in range(12):
        noise = NOISE * np.random.default_rng(seed).standard_normal(clean.position.shape)
        again = replace(clean, position=clean.position + noise)
        runs.append(identify_simulation(motion, [again], wanted, extras="friction, offsets, delay"))
    predicted = np.mean([run.shown.together for run in runs], axis=0) / np.sqrt(2.0)
    spread = np.std([[run.model[name] for name in wanted] for run in runs], ddof=1, axis=0)
    assert np.all((spread / predicted > 0.5) & (spread / predicted < 1.7))


def test_an_effort_that_the_actuator_cannot_give_and_a_component_that_cannot_change_alone_are_named(motion, tmp_path):
    strong = swing(8)
    result = identify_simulation(motion, [replace(strong, effort=1.5 * strong.effort)], {"body/link/ipos": None})
    assert any("is above the 3 N m that arm.xml lets through" in one for one in result.notes)
    thin = tmp_path / "thin.xml"
    thin.write_text(ARM.format(**START).replace(" 0.001", " 1e-6"))
    with pytest.raises(DataError, match=r"inertia/y cannot change alone .* expected body/link/inertia as a whole"):
        identify_simulation(MujocoMotion(ModelSource(thin)), [strong], {"body/link/inertia/y": None})


def test_a_file_of_two_joints_is_fitted_under_its_own_names(tmp_path):
    two = ARM.replace("    </body>", """      <body name="tip" pos="0 0 -0.8">
        <joint name="wrist" axis="0 1 0" damping="0.02"/>
        <inertial pos="0 0 -{tip}" mass="0.3" diaginertia="0.004 0.004 0.001"/>
      </body>
    </body>""").replace("</actuator>", '<motor name="second" joint="wrist"/></actuator>')  # fmt: skip
    path = tmp_path / "two.xml"
    path.write_text(two.format(**TRUE, tip=0.2))
    recording = swing(9, {**TRUE, "tip": 0.25}, text=two)
    result = identify_simulation(
        MujocoMotion(ModelSource(path)), [recording], {"body/tip/ipos": None}, window=0.5, extras="friction"
    )
    assert result.model.coordinates.names == ("arm", "wrist")
    assert result.next_step("new.xml")[1].endswith("experiment joints --simulation new.xml --plant PLANT")
    assert result.intervals["body/tip/ipos"].low < 0.25 < result.intervals["body/tip/ipos"].high
    assert not result.refused


def test_an_open_inertia_is_no_refusal_and_an_open_mass_is_one(motion):
    names = dict.fromkeys(("body/link/inertia", "body/link/mass"))
    result = identify_simulation(motion, [swing(10)], names, extras="friction")
    wide = {name: replace(one, low=0.0) for name, one in result.intervals.items()}
    for name, lost in (("body/link/inertia", False), ("body/link/mass", True)):
        uncertainty = replace(result.uncertainty, intervals={name: wide[name]})
        assert (undetermined_numbers(result.fit, uncertainty) is not None) is lost


def test_between_two_steps_a_cubic_motion_is_exact():
    t, h = 0.1 * np.arange(6), 0.1
    path = np.stack((t**3 - t, 3.0 * t**2 - 1.0), axis=1)[None, None]
    at = np.array([[0.0, 0.03, 0.25, 0.31, 0.5]])
    found = between_steps(path, at / h, h)[0, 0]
    np.testing.assert_allclose(found[:, 0], at[0] ** 3 - at[0], atol=1e-15)
    np.testing.assert_allclose(found[[0, 4], 1], [-1.0, -0.25], atol=1e-12)


def test_a_lagging_actuator_begins_a_window_with_what_was_commanded_before(tmp_path):
    lagging = ARM.replace("<motor ", '<general dyntype="filter" dynprm="0.05" ')
    path = tmp_path / "lag.xml"
    path.write_text(lagging.format(**TRUE))
    result = identify_simulation(
        MujocoMotion(ModelSource(path)),
        [swing(11, text=lagging, seconds=4.0, quiet=20)],
        {"body/link/ipos": None},
        window=0.5,
    )
    assert result.model["body/link/ipos"] == pytest.approx(0.45, rel=1e-3)


def test_a_number_at_the_edge_of_its_domain_is_named(motion):
    known = {**START, "distance": 0.45}
    bounded = {"body/link/ipos": (0.3, 0.43), "joint/arm/damping": None}
    result = identify_simulation(motion, [swing(12, known, seconds=4.0)], bounded, extras="friction")
    light = swing(13, {**START, "inertia": 0.002, "distance": 0.37}, seconds=4.0)
    lost = identify_simulation(motion, [light], dict.fromkeys(("body/link/inertia", "joint/arm/damping")))
    assert "the motion wants body/link/inertia below 0.0004 kg m^2, 0.02 of what arm.xml has" in lost.refusal
    assert any("body/link/ipos ended at the edge of its domain, 0.43 m: the motion wants more" in one
               for one in result.sentences())  # fmt: skip
