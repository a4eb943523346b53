"""What compiled answers decide with gives the very bits that Python's functions give, whatever the numbers."""

import importlib
import struct
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import (
    EstimatedVelocity,
    SoftStart,
    controller_parameters,
    make_controller,
)
from pendulum_lqr.controller_interface.law import MOST_MEMORY, MOST_NUMBERS
from pendulum_lqr.controller_interface.sampling import PeriodWatch, goes_on
from pendulum_lqr.controllers.lqr import Lqr
from pendulum_lqr.nodes.answer_rules import judge_state
from pendulum_lqr.nodes.compiled_controller import law_of
from pendulum_msgs_py.contract.angles import deviation_from_upright, from_upright
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.contract.timing import RingOfTimes
from pendulum_msgs_py.loops.trees import compile_tree
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_plant

LAWS = ("lqr", "lqr_friction", "lqi", "discrete_lqr", "pid", "pd_gravity")
finite = st.floats(allow_nan=False, allow_infinity=False)
stamps = st.integers(0, 2**31 * 10**9 - 1)


@cache
def compiled(function):
    return compile_tree(function, exact=True)


def bits(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


@pytest.mark.parametrize("name", LAWS)
@given(states=st.lists(st.tuples(finite, finite), min_size=1, max_size=20))
@example(states=[(-0.0, -0.0), (5e-324, -5e-324), (1e300, 1e300), (-1e300, 0.0), (3.2, 1.0)])
def test_a_law_answers_as_python_does_and_remembers_the_same(name, states):
    controller = make_controller(name, load_plant("thesis"), 0.002)
    assert law_of(controller) is controller
    numbers, memory = np.zeros(MOST_NUMBERS), np.zeros(MOST_MEMORY)
    numbers[: len(controller.numbers)] = controller.numbers
    memory[: len(controller.memory)] = controller.memory
    law = compiled(controller.law)
    for count, (theta, velocity) in enumerate(states):
        angle = from_upright(theta)
        assert bits(compiled(deviation_from_upright)(theta)) == bits(angle)
        expected = controller.command(count * 0.002, (angle, velocity))
        assert bits(law(count * 0.002, angle, velocity, memory, numbers)) == bits(expected)
        assert bits(*memory[: len(controller.memory)]) == bits(*controller.memory)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_is_a_function_of_a_module_by_its_name(name):
    law = make_controller(name, load_plant("thesis"), 0.002).law
    assert getattr(importlib.import_module(law.__module__), law.__name__) is law


@given(stamp=stamps, now=stamps, timeout=st.integers(0, 2**62), newest=stamps | st.just(NEVER))
def test_states_are_judged_as_python_judges_them(stamp, now, timeout, newest):
    assert compiled(judge_state)(stamp, now, timeout, newest) == judge_state(stamp, now, timeout, newest)
    assert compiled(goes_on)(stamp - max(newest, 0)) == goes_on(stamp - max(newest, 0))


def test_what_stands_around_a_law_keeps_it_from_being_compiled():
    plant = load_plant("thesis")
    lqr = make_controller("lqr", plant, 0.002)
    assert isinstance(lqr, Lqr)
    assert law_of(EstimatedVelocity(lqr, None)) is None
    assert law_of(SoftStart(lqr, 1.0)) is None

    class Other(Lqr):
        def command(self, t, x):
            return 0.0

    assert law_of(Other.design(plant, 0.002, validate(controller_parameters("lqr"), {"effort_limit": 1.0}))) is None


@given(before=st.lists(st.integers(1, 9), max_size=9), more=st.lists(st.integers(1, 9), max_size=9))
def test_times_and_stamps_that_come_together_count_as_one_after_the_other(before, more):
    one, together = RingOfTimes(4), RingOfTimes(4)
    for time in before:
        one.add(time)
        together.add(time)
    for time in more:
        one.add(time)
    together.extend(more)
    assert (one._values, one.count) == (together._values, together.count)
    for exact in (True, False):
        alone, at_once = PeriodWatch(exact=exact), PeriodWatch(exact=exact)
        series = [sum(before[:k]) for k in range(len(before) + 1)]
        series += [series[-1] + sum(more[: k + 1]) for k in range(len(more))]
        for stamp in series:
            alone.add(stamp)
        at_once.extend(series)
        assert (alone.newest_ns, list(alone._intervals_ns)) == (at_once.newest_ns, list(at_once._intervals_ns))
