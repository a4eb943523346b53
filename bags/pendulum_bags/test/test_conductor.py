"""What an experiment's node knows of a plant from its events."""

import json

import pytest
from std_msgs.msg import String

from pendulum_bags.experiments.conductor_node import PlantClient
from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.errors import PlantStoppedError


def test_of_several_events_of_a_name_the_newest_counts() -> None:
    # (without the graph: only what it has heard)
    plant = PlantClient.__new__(PlantClient)
    plant.events, plant.namespace = [], "/hw"
    assert plant.newest_event(Event.PLANT_MODE) is None
    assert plant.newest_mode() == ""
    plant.check_mode()
    for event in (
        {"name": Event.PLANT_MODE, "mode": Mode.EFFORT.value, "reason": "armed"},
        {"name": Event.PLANT_MODE, "mode": "fault", "reason": "velocity_limit"},
        {"name": Event.NOISE_END},
    ):
        assert plant.is_armed() == (len(plant.events) == 1)
        plant._on_event(String(data=json.dumps(event)))
    assert plant.newest_event(Event.NOISE_START) is None
    assert plant.newest_event(Event.NOISE_END) == {"name": Event.NOISE_END}
    assert plant.newest_mode() == "fault"
    with pytest.raises(PlantStoppedError, match="velocity_limit"):
        plant.check_mode()
