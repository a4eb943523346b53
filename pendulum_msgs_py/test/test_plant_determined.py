"""A plant file whose intervals leave open what a design needs is refused by name."""

import math

import pytest

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.determined import require_determined, undetermined
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, pendulum_plant, write_plant

ARM = pendulum_plant(inertia=0.05, damping=0.03, gravity=1.5, coulomb_friction=0.05)
FLAT = pendulum_plant(inertia=0.05, damping=0.03, gravity=0.0, effort_limit=2.0)
SLOW = pendulum_plant(inertia=0.12, damping=12.0, gravity=2.3)


@pytest.mark.parametrize(
    ("plant", "intervals", "names"),
    [
        (ARM, {"inertia": (0.04, 0.06), "gravity": (1.2, 1.8), "damping": (0.0, 0.1)}, []),
        (ARM, {"gravity": (0.0, 3.0)}, ["gravity"]),
        (ARM, {"gravity": (1.0, 1e7)}, ["gravity"]),
        (ARM, {"inertia": (0.0, 0.1)}, ["inertia"]),
        (ARM, {"damping": (0.0, 1059.0)}, ["damping"]),
        (ARM, {"coulomb_friction": (0.0, 300.0)}, ["coulomb_friction"]),
        (ARM, {"transport_delay": (0.0, 5.0), "torque_offset": (-900.0, 900.0)}, ["transport_delay", "torque_offset"]),
        # What gives a friction its form is no size.
        (ARM, {"stribeck_velocity": (0.02, 1e5)}, []),
        # Behind a strong damping the inertia is a fast lag: it may be anything from 0 up to a known end.
        (SLOW, {"inertia": (0.0, 0.2)}, []),
        (SLOW, {"inertia": (0.0, 20.0)}, ["inertia"]),
        # A gravity of 0 is known where it may be next to nothing only, and no damping is strong beside none.
        (FLAT, {"inertia": (0.04, 0.06), "gravity": (0.0, 0.01)}, []),
        (FLAT, {"inertia": (0.0, 0.1), "gravity": (0.0, math.inf)}, ["inertia", "gravity"]),
    ],
)
def test_what_leaves_a_design_open_is_named(plant, intervals, names):
    assert list(undetermined(plant, intervals)) == names


def test_a_plant_file_of_one_joint_and_of_several_is_refused_by_its_own_interval(tmp_path):
    require_determined("thesis")
    require_determined("cart_pole")
    one = write_plant(tmp_path / "one.yaml", ARM, intervals={"gravity": (0.0, 2.3e7)})
    with pytest.raises(ParameterError, match=r"one.yaml: gravity is 1.5 with the interval 0 to 2.3e\+07"):
        require_determined(one)
    several = write_plant(
        tmp_path / "several.yaml", load_mechanism("cart_pole"), intervals={"pole_inertia": (0.0, 0.1)}
    )
    with pytest.raises(ParameterError, match="pole_inertia is"):
        require_determined(several)
