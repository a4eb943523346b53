"""The plant in a picture, identified by its joints' names and its own description."""

from __future__ import annotations

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.plant_differences import read_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant

__all__ = ["ShownPlant", "described_mechanism", "shown_pendulum"]


class ShownPlant:
    """The plant behind a topic of states; ``pendulum`` is drawn for any plant of one joint.

    Attributes:
        joints: The drawn joints, in order.
        parameters: The drawn plant; None until the description of one of several joints arrives.
    """

    def __init__(self, topic: str, pendulum: PlantParameters) -> None:
        self.joints: tuple[str, ...] = (JOINT,)
        self.parameters: PlantParameters | None = pendulum
        self._pendulum = pendulum
        self._topic = topic
        self._named: tuple[str, ...] | None = None
        self._description = ""

    @property
    def missing(self) -> str:
        """What is still missing to draw the plant, or an empty string."""
        return "" if self.parameters is not None else f"waiting for the parameters of {', '.join(self.joints)}"

    def take_names(self, names: tuple[str, ...]) -> None:
        """Take the names of a state's joints; a ParameterError if no drawable plant has them."""
        if names == self._named:
            return
        known = [tuple(joint.name for joint in one.joints) for one in MECHANISMS.values()]
        if JOINT not in names and names not in known:
            listed = "; ".join(", ".join(each) for each in known)
            raise ParameterError(
                f"{self._topic} tells of {', '.join(names) or 'no joint'}, which cannot be drawn; expected the joints "
                f"of a mechanism, in its order: {listed}"
            )
        self._named, self.joints = names, (JOINT,) if JOINT in names else names
        self._find()

    def take_description(self, text: str) -> None:
        """Take the plant's description from its diagnostics; a ParameterError for other text."""
        if text and text != self._description:
            self._description = text
            self._find()

    def _find(self) -> None:
        described = described_mechanism(self._description)
        found = self._pendulum if len(self.joints) == 1 else described
        # A description of other joints is that of an earlier or later plant.
        self.parameters = found if found is not None and found.coordinates.names == self.joints else None


def shown_pendulum(effort_scale: float) -> PlantParameters:
    """Return the drawn pendulum; only the torque of a full arc [N m] matters."""
    return pendulum_plant(1.0, 0.0, 1.0, effort_limit=effort_scale)


def described_mechanism(text: str) -> PlantParameters | None:
    """Return the plant of several joints in a description, or None; a ParameterError for other text."""
    plants = read_plants(text) if text else ()
    return next((plant for plant in plants if not plant.is_pendulum), None)
