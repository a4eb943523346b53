"""``python -m pendulum_lqr design``."""

import json

import pytest

from pendulum_lqr.design_command.design_cli import main
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant


def test_the_table_of_the_thesis_is_printed_to_its_last_digit(capsys):
    assert main(["--preset", "thesis"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for row in (
        "0.14, -214.14 │ 0.142471, -214.142471",
        "-0.30, -214.22 │ -0.303843, -214.219476",
        "-0.30, -214.91 │ -0.302863, -214.912785",
        "-2.69, -214.20 │ -2.687959, -214.202827",
        "-2.68, -214.90 │ -2.679285, -214.896296",
        "33.345265, 0.158993",
    ):
        assert row in printed
    assert "K = [33.345, 0.159], tau = 0.3720 s; from the rounded eigenvalue 1/2.69 = 0.3717 s" in printed


def test_json_has_every_pair_of_weights(capsys):
    assert main(["--preset", "dfki", "--q", "10,1", "--q", "100,1", "--r", "1", "--r", "0.1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [(row["q"], row["r"]) for row in document["rows"]] == [
        (None, None),
        ([10.0, 1.0], 1.0),
        ([10.0, 1.0], 0.1),
        ([100.0, 1.0], 1.0),
        ([100.0, 1.0], 0.1),
    ]
    assert document["rows"][0]["time_constant"] is None
    assert document["rows"][1]["margins"]["gain_up"] is None
    assert document["rows"][1]["largest_period"] == pytest.approx(0.1856, abs=1e-3)


def test_the_series_elastic_plant_is_designed_for_as_it_is_simulated(capsys):
    assert main(["--preset", "x5_9", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["states"] == ["theta", "theta_dot", "motor_angle", "motor_velocity"]
    assert document["rows"][0]["poles"][0] == pytest.approx([0.129009, 0.0], abs=1e-6)
    for row in document["rows"][1:]:
        assert row["stable"]
        assert len(row["K"]) == 2
        assert max(pole[0] for pole in row["poles"]) < -0.3
        assert row["margins"]["gain_up"] > 2.0


def test_a_plant_with_delay_has_margins_that_count_it(tmp_path, capsys):
    plant = load_plant("dfki").with_values(transport_delay=0.02, name="late")
    path = write_plant(tmp_path / "late.yaml", plant)
    margins = []
    for name in (str(path), "dfki"):
        assert main(["--plant", name, "--q", "100,0.01", "--r", "0.1", "--json"]) == 0
        margins.append(json.loads(capsys.readouterr().out)["rows"][1]["margins"])
    late, prompt = margins
    assert late["delay"] == pytest.approx(prompt["delay"] - 0.02, abs=1e-6)
    assert late["phase"] == pytest.approx(prompt["phase"] - 0.02 * prompt["crossover"], abs=1e-4)
    assert prompt["gain_up"] is None
    assert 1.0 < late["gain_up"] < 10.0
    assert main(["--plant", str(path)]) == 0
    assert "transport delay 0.02 s: counted in margins and periods" in capsys.readouterr().out


def test_a_plant_file_and_another_fixed_point(tmp_path, capsys):
    path = write_plant(tmp_path / "mine.yaml", load_plant("dfki").with_values(name="mine"))
    assert main(["--plant", str(path), "--theta", "0.5", "--q", "1,1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["plant"] == "mine"
    assert document["effort"] == pytest.approx(2.996955 * 0.479425538604203)


def test_the_figures_are_written(tmp_path, capsys):
    arguments = ["--preset", "dfki", "--q", "10,1", "--r", "1", "--figures", str(tmp_path / "figures")]
    assert main(arguments) == 0
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"pole_map.png", "root_locus.png", "bode.png", "step_response.png", "phase_portrait.png"}
    assert all(path.stat().st_size > 20_000 for path in (tmp_path / "figures").iterdir())
    assert "phase_portrait.png" in capsys.readouterr().out


def test_a_moving_reference_is_designed_for_with_the_weights_of_the_chosen_row(capsys):
    arguments = ["--preset", "thesis", "--tracking", "amplitude=0.2", "--tracking", "period=0.002"]
    assert main([*arguments, "--json"]) == 0
    tracking = json.loads(capsys.readouterr().out)["tracking"]
    middle = tracking["frozen"][len(tracking["frozen"]) // 2]
    assert middle["K"] == pytest.approx([33.345265, 0.158993], abs=1e-5)
    assert middle["radius"] == pytest.approx(0.99462, abs=1e-5)
    assert [row["angle"] for row in tracking["frozen"]] == sorted(row["angle"] for row in tracking["frozen"])
    # b A w, where the reference is fastest.
    assert tracking["effort"] == pytest.approx(11.77 * 0.2 * 2.0 * 3.14159 * 0.2, rel=0.01)
    assert main([*arguments, "--row", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Gain along the reference" in printed
    assert "combination 1 along sine of 0.2 rad at 0.2 Hz: takes up to 2.979 of 13 N m" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "thesys"], "plant is 'thesys'; expected one of the presets"),
        (["--q", "1"], "--q is '1'; expected 2 numbers, for theta, theta_dot, as 100,0.01"),
        (["--q", "1,x"], "--q is '1,x'; expected 2 numbers"),
        (["--q", "1,-1"], "expected no negative weight"),
        (["--r", "0"], "r is 0.0 1/(N m)^2; expected a finite weight > 0"),
        (["--row", "9"], "--row is 9; expected 1 to 4"),
        (["--effort-limit", "-5"], "--effort-limit is -5.0 N m; expected a finite number > 0"),
        (["--effort-limit", "nan"], "--effort-limit is nan N m; expected a finite number > 0"),
        (["--theta", "nan"], "theta of the fixed point is nan rad"),
        (["--tracking", "amplitud=1"], "--tracking is 'amplitud=1'; did you mean 'amplitude'"),
        (["--tracking", "amplitude=big"], "--tracking is 'amplitude=big'; expected a number, as amplitude=0.3"),
        (["--tracking", "reference=saw"], "reference is 'saw'; expected one of sine, steps"),
        (["--tracking", "frequency=2"], "following the reference takes up to"),
        (["--tracking", "period=0.9"], "unstable at -0.3 rad from upright with a period of 0.9 s"),
        (["--figures", "/proc/nowhere"], "figures in /proc/nowhere cannot be written"),
    ],
)
def test_a_mistake_ends_with_one_sentence_and_code_2(arguments, message, capsys):
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert "Traceback" not in told


def test_help_has_an_example(capsys):
    assert main(["--help"]) == 0
    assert "--preset dfki --q 10,1" in " ".join(capsys.readouterr().out.split())


def test_a_plant_that_its_recordings_do_not_determine_is_refused(tmp_path, capsys):
    plant = load_plant("dfki")
    open_ended = write_plant(tmp_path / "open.yaml", plant, intervals={"gravity": (0.0, 2.3e7)})
    assert main(["--plant", str(open_ended)]) == 2
    assert "gravity is" in capsys.readouterr().err
    known = write_plant(
        tmp_path / "known.yaml", plant, intervals={"gravity": (0.9 * plant.gravity, 1.1 * plant.gravity)}
    )
    assert main(["--plant", str(known), "--json"]) == 0
