"""Controllers that are written once for any mechanism: catch, tracking, MPC, stored swing-ups."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.linear.design import DesignError, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.swing_up import catch as catch_module
from pendulum_lqr.swing_up import swing_up_cli
from pendulum_lqr.swing_up.catch import CaughtRegion, MechanismCatch, deviation_of, make_mechanism_catch
from pendulum_lqr.swing_up.ilqr import IlqrPlan, IlqrProblem, IlqrWeights
from pendulum_lqr.swing_up.mpc import ITERATIONS, PATIENCE, PLAN, RETRIES, MechanismMpc
from pendulum_lqr.swing_up.planned import PlannedSwingUp
from pendulum_lqr.swing_up.search import PlanSettings
from pendulum_lqr.swing_up.stored_swing_up import default_catch, stored_trajectory, tracked_swing_up
from pendulum_lqr.swing_up.trajectory import (
    SwingUpSearch,
    cheapest_swing_up,
    load_trajectory,
    search_swing_up,
    write_trajectory,
)
from pendulum_lqr.swing_up.tvlqr import MechanismTvlqr
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.runge_kutta import along_2, rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import delayed_plant

DT = 0.002
Q, R = (10.0, 10.0, 1.0, 1.0), 1.0


def step(plant: PlantParameters, x: Vector, effort: Vector) -> Vector:
    """Return the state one period later, without friction."""
    torque = plant.coordinates.spread(effort)
    q, v = rk4_joints(plant.mechanism.forward, along_2, x[:2], x[2:], torque, torque, torque, DT, plant.packed)
    return (*q, *v)


@pytest.mark.parametrize("name", ["acrobot", "cart_pole"])
def test_the_level_of_a_catch_is_that_of_trials_that_nobody_cut_short(name: str) -> None:
    plant = load_mechanism(name)
    catch = make_mechanism_catch(plant, (1.0, 1.0, 1.0, 1.0), 1.0)
    samples = catch_module._samples_of_level_1(catch.gain, 2)
    # Nine tenths of what was found; the last bisection halved the way to four times as much four times.
    found = catch.region.level / 0.9
    for factor, caught in ((1.0, True), (1.001 * 4.0 ** (1.0 / 16.0), False)):
        deviations = math.sqrt(factor * found) * samples
        assert catch_module._all_caught(plant, catch.gain, deviations, 0.0) is caught, factor


def test_a_region_is_sampled_once_for_each_plant_and_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = load_mechanism("cart_pole")
    region = make_mechanism_catch(plant, Q, R).region
    monkeypatch.setattr(catch_module, "_all_caught", lambda *_: False)
    assert make_mechanism_catch(load_mechanism("cart_pole"), Q, R).region == region
    for other, r in ((plant, 1.01 * R), (plant.with_values({"cart_mass": 1.01}), R)):
        with pytest.raises(DesignError, match="catches no state"):
            make_mechanism_catch(other, Q, r)


def test_an_lqr_that_asks_for_too_much_catches_no_state_and_is_refused() -> None:
    with pytest.raises(DesignError, match="catches no state near upright"):
        make_mechanism_catch(load_mechanism("acrobot"), (100.0, 100.0, 1.0, 1.0), 0.01)


def test_the_catch_takes_over_within_its_region_and_releases_beyond_twice_that() -> None:
    plant = load_mechanism("pendubot_frictionless")
    catch = make_mechanism_catch(plant, Q, R)
    assert "not proven" in catch.region.describe()
    rng = np.random.default_rng(99)

    def caught(share: float, direction: np.ndarray) -> bool:
        scale = math.sqrt(share * catch.region.level / float(direction @ catch.gain.S @ direction))
        x: Vector = tuple(scale * direction + np.array([*plant.coordinates.goal, 0.0, 0.0]))
        for _ in range(1000):
            x = step(plant, x, catch.command(deviation_of(plant.coordinates, x)))
        return bool(np.max(np.abs(deviation_of(plant.coordinates, x))) < 0.1)

    # Other states than those that it was sampled from.
    assert all(caught(1.0, direction) for direction in rng.standard_normal((12, 4)))
    # The way in which the limit tells first: all of the effort for nothing.
    assert not caught(6.0, np.linalg.solve(catch.gain.S, catch.gain.K))
    unit = np.array([1.0, 0.0, 0.0, 0.0]) / math.sqrt(catch.gain.S[0, 0] / catch.region.level)
    assert [catch.holds(scale * unit) for scale in (1.1, 0.9, 1.1, 1.3, 1.5, 1.1)] == [
        False,
        True,
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("name", ["acrobot_frictionless", "pendubot_frictionless"])
def test_tracking_brings_a_disturbed_swing_up_upright_and_open_loop_does_not(name: str) -> None:
    plant = load_mechanism(name)
    controller = tracked_swing_up(plant, DT)
    feedback: Vector = (0.02, -0.02, 0.0, 0.0)
    open_loop = feedback
    for k in range(2500):
        feedback = step(plant, feedback, controller.efforts(k * DT, feedback[:2], feedback[2:]))
        effort = controller.planned[k] if k < len(controller.planned) else (0.0,)
        open_loop = step(plant, open_loop, tuple(float(u) for u in effort))
    assert np.max(np.abs(deviation_of(plant.coordinates, feedback))) < 1e-3
    assert np.max(np.abs(deviation_of(plant.coordinates, open_loop))) > 0.5
    # Thrown far off it gives no effort where nobody recovers it, and does not jump back to the trajectory either.
    controller.reset()
    controller.efforts(0.0, (0.0, 0.0), (0.0, 0.0))
    assert controller.efforts(DT, (1.5, 3.0), (25.0, -25.0)) == (0.0,)
    assert controller.efforts(2 * DT, (0.0, 0.0), (0.0, 0.0)) == (0.0,)
    controller.reset()
    assert controller.efforts(0.0, (0.0, 0.0), (0.0, 0.0)) != (0.0,)


def test_a_swing_up_begins_at_hanging_whatever_turns_were_made_before() -> None:
    plant = load_mechanism("acrobot_frictionless")
    controller = make_controller("tvlqr", plant, DT)
    fresh = [controller.efforts(k * DT, (0.0, 0.0), (0.0, 0.0)) for k in range(5)]
    for turns in ((1, 0), (-1, 2)):
        controller.reset()
        hanging = (2.0 * math.pi * turns[0], 2.0 * math.pi * turns[1])
        again = [controller.efforts(k * DT, hanging, (0.0, 0.0)) for k in range(5)]
        assert again == [pytest.approx(effort, abs=1e-9) for effort in fresh]
    assert any(effort != (0.0,) for effort in fresh)


@pytest.mark.timeout(400)
def test_iterative_lqr_and_mpc_bring_a_cart_pole_up_within_its_limits() -> None:
    """Takes some ten seconds: it compiles the problem of a mechanism, once for all that is asked here."""
    plant = load_mechanism("cart_pole")
    catch = default_catch(plant)
    problem = IlqrProblem(plant, 0.05, IlqrWeights(terminal=0.1), catch.gain.S)
    guess = 3.0 * np.sin(np.arange(50.0)[:, None])
    still = (0.0, 0.0)
    first = problem.solve(still, still, (0.0,), guess, 0)
    costs = [first.cost] + [problem.solve(still, still, (0.0,), guess, count).cost for count in (1, 5, 40)]
    assert all(later <= earlier for earlier, later in pairwise(costs))
    assert costs[-1] < 0.5 * costs[0]
    tight = replace(problem, limit=0.2).solve(still, still, (0.0,), guess, 40)
    assert np.max(np.abs(tight.efforts)) <= 0.2 * plant.effort_limits[0]
    # The plan is a motion of the plant: each node follows from the one before.
    plan = problem.solve(still, still, (0.0,), guess, 40)
    for before, after in zip(plan.states[:-1], plan.states[1:], strict=True):
        ends = [(float(before[4]), 0.0), (0.5 * float(before[4] + after[4]), 0.0), (float(after[4]), 0.0)]
        q, v = rk4_joints(
            plant.mechanism.forward, along_2, tuple(before[:2]), tuple(before[2:4]), *ends, 0.05, plant.packed
        )
        assert (*q, *v) == pytest.approx(tuple(after[:4]), abs=1e-9)
    controller = MechanismMpc(DT, catch)
    x: Vector = (0.0,) * 4
    efforts = []
    for k in range(2500):
        efforts.append(controller.efforts(k * DT, x[:2], x[2:]))
        x = step(plant, x, efforts[-1])
    assert np.max(np.abs(deviation_of(plant.coordinates, x)[1:])) < 0.05
    assert max(abs(effort[0]) for effort in efforts) <= plant.effort_limits[0]
    controller.reset()
    assert controller.efforts(0.0, (0.0, 0.0), (0.0, 0.0)) == efforts[0]
    # A first plan takes so long that a plant in real time lets its answer go: the next does not search as long again.
    solved = []
    solve = controller.search.solve
    controller.search.solve = lambda *asked: (solved.append(asked), solve(*asked))[1]  # type: ignore[method-assign]
    controller.reset()
    controller.efforts(0.0, (0.0, 0.0), (0.0, 0.0))
    assert len(solved) == PLAN.guesses
    solved.clear()
    late = controller.efforts(0.1, (0.0, 0.0), (0.0, 0.0))
    assert len(solved) == 1 + RETRIES
    assert controller.search.arrives(controller._plan)
    assert late == pytest.approx(efforts[0], abs=0.5)
    # On the graph it is the same, and begins anew with a plant that begins anew, whatever turns were made before.
    on_the_graph = make_controller("nmpc", plant, DT)
    assert "s by iterative LQR, then LQR within" in on_the_graph.describe()
    # What it was compiled with is no plan.
    elsewhere = on_the_graph.efforts(0.0, (0.3, 2.0), (0.5, -1.0))
    on_the_graph.reset()
    assert on_the_graph.efforts(0.0, (0.3, 2.0), (0.5, -1.0)) == elsewhere
    for turned in (0.0, 2.0 * math.pi):
        on_the_graph.reset()
        again = []
        x = (0.0,) * 4
        for k in range(30):
            again.append(on_the_graph.efforts(k * DT, (x[0], x[1] + turned), x[2:]))
            x = step(plant, x, again[-1])
        assert np.array(again) == pytest.approx(np.array(efforts[:30]), abs=1e-6)
    on_the_graph.check(DT)
    with pytest.raises(ParameterError, match=r"nmpc plans for answers every 0\.002 s; expected states at that period"):
        on_the_graph.check(0.01)


@pytest.mark.timeout(400)
def test_a_planned_swing_up_is_searched_once_and_anew_only_where_it_is_thrown_off() -> None:
    plant = load_mechanism("cart_pole")
    few = PlanSettings(IlqrWeights(1.0, 0.0, 0.0005, 2e-6, 1e-4, 3.0), step=0.02, nodes=100, guesses=4, iterations=30)
    controller = PlannedSwingUp(DT, default_catch(plant), few)
    searched: list[Vector] = []
    guessed = controller.search.guessed
    controller.search.guessed = lambda x, *asked: (searched.append(x), guessed(x, *asked))[1]  # type: ignore[method-assign]

    def run(x: Vector, kick: float = 0.0) -> tuple[Vector, list[float]]:
        controller.reset()
        searched.clear()
        efforts = []
        for k in range(2500):
            (effort,) = controller.efforts(k * DT, x[:2], x[2:])
            efforts.append(effort)
            x = step(plant, x, (effort,))
            if k == 200 and kick:
                x = thrown = (*x[:3], x[3] + kick)
        if kick:
            assert searched[1][2:] == thrown[2:]
        return x, efforts

    def upright(x: Vector) -> bool:
        return bool(np.max(np.abs(deviation_of(plant.coordinates, x)[1:])) < 0.05)

    end, efforts = run((0.0, 0.0, 0.0, 0.0))
    assert upright(end)
    assert searched == [(0.0, 0.0, 0.0, 0.0)]
    assert max(map(abs, efforts)) <= plant.effort_limits[0]
    again, same = run((0.0, 0.0, 0.0, 0.0))
    assert same == efforts
    assert again == end
    # Turns made before are none of its business.
    turned, _ = run((0.2, 0.5 + 4.0 * math.pi, 0.1, -1.0))
    assert upright(turned)
    assert searched[0] == pytest.approx((0.2, 0.5, 0.1, -1.0))
    kicked, _ = run((0.0, 0.0, 0.0, 0.0), kick=6.0)
    assert upright(kicked)
    assert controller.catch.active
    controller.reset()
    assert not controller.catch.active
    # What arrives goes before what is cheaper.
    plan = controller.search.solve((0.0,) * 4, (0.0,), np.zeros((few.nodes, 1)), 0)
    there = plan._replace(states=np.tile([*plant.coordinates.goal, 0.0, 0.0, 0.0], (2, 1)), cost=9.0)
    assert min(plan._replace(cost=1.0), there, there._replace(cost=8.0), key=controller._rank).cost == 8.0
    with pytest.raises(ParameterError, match=r"plan begins at .*nan.*; expected finite numbers"):
        controller.efforts(0.0, (0.0, math.nan), (0.0, 0.0))
    # From where every plan runs away from all numbers there is nothing to follow.
    assert controller.efforts(0.0, (0.0, 0.0), (1e200, 1e200)) == (0.0,)


@pytest.mark.timeout(400)
def test_ilqr_on_the_graph_swings_up_under_the_limit_that_it_was_given_and_gives_nothing_where_it_is_lost() -> None:
    plant = load_mechanism("cart_pole")
    limit = 0.8 * plant.effort_limits[0]
    controller = make_controller("ilqr", plant, 0.01, {"guesses": 4, "effort_limit": limit})
    assert "swing-up of 4 s by TVLQR, then LQR within" in controller.describe()
    simulated = MechanismPlant(plant, dt=0.01)
    q, v = (0.0, 0.0), (0.0, 0.0)
    efforts, way = [], []
    for k in range(600):
        (effort,) = controller.efforts(0.01 * k, q, v)
        state = simulated.step((effort,))
        q, v = state.position, state.velocity
        efforts.append(abs(effort))
        way.append(abs(q[0]))
    assert np.max(np.abs(deviation_of(plant.coordinates, (*q, *v)))) < 0.1
    assert 0.5 * limit < max(efforts) <= limit
    assert max(way) < plant.stops[0][1]
    controller.reset()
    assert controller.efforts(0.0, (0.5, 1.0), (0.0, 3.0)) == (0.0,)
    # It stays lost: a trajectory that was left is not found again by chance.
    assert controller.efforts(0.01, (0.0, 0.0), (0.0, 0.0)) == (0.0,)
    with pytest.raises(ParameterError, match=r"the trajectory is followed every 0\.01 s"):
        controller.check(0.002)


def test_a_swing_up_that_runs_into_an_end_stop_is_none() -> None:
    plant = load_mechanism("cart_pole")
    narrow = plant.with_values({"cart.lower_stop": -0.2, "cart.upper_stop": 0.2})
    catch = default_catch(plant)
    search = SwingUpSearch(IlqrWeights(1.0, 0.0, 0.02, 1e-4, 5e-3, 10.0))
    with pytest.raises(DesignError, match=r"guess 2 of 'cart_pole' runs into an end stop"):
        search_swing_up(replace(catch, plant=narrow), search, 2)
    assert np.max(np.abs(search_swing_up(catch, search, 2).states[:, 0])) < plant.stops[0][1]
    with pytest.raises(DesignError, match=r"none of 2 guesses of 'cart_pole' ends upright; expected more guesses"):
        cheapest_swing_up(replace(catch, plant=narrow), search, (2, 3))
    best, count = cheapest_swing_up(catch, search, (0, 2))
    assert (best.how["seed"], count) == (2, 2)


def test_tvlqr_follows_the_file_of_a_search_and_refuses_that_of_another_mechanism(tmp_path: Path) -> None:
    plant = load_mechanism("cart_pole")
    trajectory = search_swing_up(
        default_catch(plant), SwingUpSearch(IlqrWeights(1.0, 0.0, 0.02, 1e-4, 5e-3, 10.0), duration=3.0), 2
    )
    path = tmp_path / "cart_pole.json"
    write_trajectory(path, trajectory)
    controller = make_controller("tvlqr", plant, DT, {"trajectory": str(path)})
    assert "swing-up of 3 s by TVLQR" in controller.describe()
    x: Vector = (0.0, 0.0, 0.0, 0.0)
    for k in range(2500):
        x = step(plant, x, controller.efforts(k * DT, x[:2], x[2:]))
    assert np.max(np.abs(deviation_of(plant.coordinates, x)[1:])) < 0.05
    with pytest.raises(ParameterError, match="has the joints cart, pole and 1 motors; expected arm, pendulum and 1"):
        make_controller("tvlqr", load_mechanism("furuta"), DT, {"trajectory": str(path)})
    with pytest.raises(ParameterError, match=r"gone\.json does not exist"):
        make_controller("tvlqr", plant, DT, {"trajectory": str(tmp_path / "gone.json")})


def test_a_swing_up_whose_lqr_would_not_hold_what_comes_up_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"tvlqr asked every 0\.002 s does not settle on plant 'acrobot_friction"):
        make_controller("tvlqr", delayed_plant("acrobot_frictionless", 0.03), DT)


@pytest.mark.parametrize("name", ["nmpc", "ilqr"])
def test_plans_without_dry_friction_are_not_for_a_passive_joint_that_has_some(name: str) -> None:
    with pytest.raises(
        ParameterError, match=rf"{name} plans .* elbow of plant 'pendubot' is passive with 0\.12 N m; expected 0"
    ):
        make_controller(name, load_mechanism("pendubot"), DT)


@pytest.mark.timeout(400)
def test_a_swing_up_that_its_lqr_would_not_hold_at_this_period_is_refused() -> None:
    # Up there it would go from limit to limit for good: plans wait for nothing, their LQR for the delay and the period.
    late = delayed_plant("cart_pole", 0.3)
    refusal = r"nmpc asked every 0\.01 s does not settle on plant 'cart_pole': .*; expected a faster plant$"
    with pytest.raises(ParameterError, match=refusal):
        make_controller("nmpc", late, 0.01)
    # As long as nobody knows the period, it is designed for one, and judged when the first states have come.
    controller = make_controller("nmpc", late, 0.01, checked=False)
    with pytest.raises(ParameterError, match=refusal):
        controller.check(0.01)
    # Of a period that differs by less than counts as another it is asked whether it settles at that one.
    tardy = make_controller("nmpc", delayed_plant("cart_pole", 0.05), 0.05)
    with pytest.raises(ParameterError, match=r"nmpc asked every 0\.059 s does not settle on plant 'cart_pole'"):
        tardy.check(0.059)


@pytest.mark.timeout(400)
def test_a_wild_state_does_not_cost_a_plan_and_from_wild_states_alone_there_is_none() -> None:
    plant = load_mechanism("cart_pole")
    gain = output_lqr(linearise(plant), *plant.mechanism.weights)
    controllers = [MechanismMpc(DT, MechanismCatch(plant, gain, CaughtRegion(0.1, 0))) for _ in range(2)]
    x: Vector = (0.0,) * 4
    wild = (0.0, 1.0, 1e200, -1e200)
    # In the middle of the swing a state at which it plans again is a glitch of the sensors, for one of them.
    for k in range(240):
        seen = (x, wild if k == 200 else x)
        efforts = [each.efforts(k * DT, y[:2], y[2:])[0] for each, y in zip(controllers, seen, strict=True)]
        assert abs(efforts[1] - efforts[0]) < 0.5
        x = step(plant, x, (efforts[0],))
    controllers[1].reset()
    for k in range(30):
        assert controllers[1].efforts(k * DT, wild[:2], wild[2:]) == (0.0,)
    # What was no plan leaves nothing behind.
    controllers[0].reset()
    late, fresh = controllers[1].efforts(30 * DT, x[:2], x[2:]), controllers[0].efforts(0.0, x[:2], x[2:])
    assert late == pytest.approx(fresh, abs=1.0)


@pytest.mark.timeout(400)
def test_mpc_plans_from_the_last_plan_and_searches_where_that_leads_nowhere_or_there_is_none() -> None:
    plant = load_mechanism("cart_pole")
    gain = output_lqr(linearise(plant), *plant.mechanism.weights)
    controller = MechanismMpc(DT, MechanismCatch(plant, gain, CaughtRegion(0.1, 0)))
    search = controller.search
    nodes = round(PLAN.step / DT)
    asked: list[tuple[object, ...]] = []
    solve = search.solve
    search.solve = lambda *given: (asked.append(given), solve(*given))[1]  # type: ignore[method-assign]
    outcomes = [True]
    search.arrives = lambda _: outcomes[-1]  # type: ignore[method-assign]
    x: Vector = (0.0,) * 4

    def counted(k: int) -> int:
        asked.clear()
        nonlocal x
        effort = controller.efforts(k * DT, x[:2], x[2:])
        x = step(plant, x, effort)
        return len(asked)

    assert [counted(k) for k in range(nodes)] == [PLAN.guesses] + [0] * (nodes - 1)
    # At each node once, from where the plan would be, by its feedback and a few iterations.
    plan = controller._plan
    assert plan is not None
    assert counted(nodes) == 1
    _, before, guess, iterations, around = asked[0]
    assert before == pytest.approx(plan.efforts[0])
    assert np.array(guess) == pytest.approx(np.vstack([plan.efforts[1:], [[0.0]]]))
    assert iterations == ITERATIONS
    assert isinstance(around, IlqrPlan)
    assert around.gains[0] == pytest.approx(plan.gains[1])
    # Where plans do not arrive, guesses are tried again, once in a while.
    begin = nodes + 1
    for outcome, tried in ((True, 1), (False, 1 + RETRIES)):
        outcomes.append(outcome)
        planned = [count for count in map(counted, range(begin, begin + PATIENCE * nodes)) if count]
        begin += PATIENCE * nodes
        assert len(planned) == PATIENCE
        assert max(planned) == tried
    # Thrown off while the LQR holds it, it searches as at the start: its plan of long ago led elsewhere.
    x = (*plant.coordinates.goal, 0.0, 0.0)
    assert counted(begin) == 0
    x = (0.0,) * 4
    assert counted(begin + 1) == PLAN.guesses
    x = (*plant.coordinates.goal, 0.0, 0.0)
    assert counted(begin + 2) == 0
    assert controller.catch.active
    controller.reset()
    assert not controller.catch.active


def test_nothing_is_planned_from_a_state_that_is_no_number() -> None:
    plant = load_mechanism("cart_pole")
    gain = output_lqr(linearise(plant), *plant.mechanism.weights)
    controller = MechanismMpc(DT, MechanismCatch(plant, gain, CaughtRegion(1.0, 0)))
    for x in ((0.0, math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, math.inf)):
        with pytest.raises(ParameterError, match=r"plan begins at .*(nan|inf).*; expected finite numbers"):
            controller.efforts(0.0, x[:2], x[2:])


def test_a_search_whose_file_cannot_be_written_ends_before_it_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pendulum_lqr.swing_up.trajectory.search_swing_up", lambda *_: pytest.fail("searched"))
    (tmp_path / "file").touch()
    assert swing_up_cli.main(["--guesses", "1", "--out", f"{tmp_path}/file/x.json"]) == 2
    assert "file/x.json cannot be written: " in capsys.readouterr().err


def test_a_trajectory_file_gives_back_what_was_written_and_says_what_is_wrong_with_another(tmp_path: Path) -> None:
    trajectory = stored_trajectory(load_mechanism("acrobot_frictionless"))
    write_trajectory(tmp_path / "again.json", trajectory)
    again = load_trajectory(tmp_path / "again.json")
    assert (again.states == trajectory.states).all()
    assert (again.efforts == trajectory.efforts).all()
    assert again.how == trajectory.how
    document = json.loads((tmp_path / "again.json").read_text(encoding="utf-8"))
    for text, message in (
        ("{}", "none.json has the format None; expected pendulum_trajectory/1"),
        ("[]", "is no trajectory"),
        ("{", "is no trajectory"),
        (json.dumps({key: value for key, value in document.items() if key != "plant"}), "plant is None; expected text"),
        (json.dumps({**document, "step": math.nan}), "has numbers that are not finite"),
        (json.dumps({**document, "efforts": [[math.inf]] * len(document["states"])}), "numbers that are not finite"),
        (json.dumps({**document, "efforts": document["efforts"][1:]}), r"expected \(N, 4\) and \(N, m\)"),
    ):
        (tmp_path / "none.json").write_text(text, encoding="utf-8")
        with pytest.raises(ParameterError, match=message):
            load_trajectory(tmp_path / "none.json")
    with pytest.raises(ParameterError, match=r"gone.json does not exist"):
        load_trajectory(tmp_path / "gone.json")
    with pytest.raises(ParameterError, match=r"again.json/x.json cannot be written: File exists"):
        write_trajectory(tmp_path / "again.json" / "x.json", trajectory)
    with pytest.raises(ParameterError, match="no swing-up is stored for plant 'cart_pole'; expected one of acrobot_f"):
        stored_trajectory(load_mechanism("cart_pole"))
    plant = load_mechanism("cart_pole")
    catch = default_catch(plant)
    with pytest.raises(ParameterError, match="has the joints shoulder, elbow and 1 motors; expected cart, pole and 1"):
        MechanismTvlqr(DT, trajectory, catch, q=Q, r=R)


@pytest.mark.parametrize("name", ["nmpc", "ilqr"])
def test_plans_are_for_several_joints(name: str, tmp_path: Path) -> None:
    stopped = tmp_path / "stopped.yaml"
    stopped.write_text(
        "format: pendulum_plant/2\nname: stopped\nmodel: pendulum\nparameters:\n"
        "  inertia: {value: 0.1, unit: kg m^2}\n  gravity: {value: 1.0, unit: N m}\n"
        "joints:\n  pendulum_joint:\n    upper_stop: {value: 4.0, unit: rad}\n"
        "    actuator: {effort_limit: {value: 2.0, unit: N m}}\n"
    )
    with pytest.raises(ParameterError, match="plant 'stopped' has one joint; expected several"):
        make_controller(name, load_mechanism(str(stopped)), DT)
