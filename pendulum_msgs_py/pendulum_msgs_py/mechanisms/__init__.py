"""Mechanisms: equations of motion of one joint or several, each in one file and one line of ``MECHANISMS``."""

from pendulum_msgs_py.mechanisms.cart_pole import CART_POLE
from pendulum_msgs_py.mechanisms.double_pendulum import DOUBLE_PENDULUM
from pendulum_msgs_py.mechanisms.furuta import FURUTA
from pendulum_msgs_py.mechanisms.joint_torques import with_torques
from pendulum_msgs_py.mechanisms.mechanism import TORQUES_SUFFIX, Body, Mechanism, Rotor
from pendulum_msgs_py.mechanisms.pendulum import PENDULUM
from pendulum_msgs_py.mechanisms.reaction_wheel import REACTION_WHEEL
from pendulum_msgs_py.mechanisms.triple_pendulum import TRIPLE_PENDULUM

__all__ = ["MECHANISMS", "Body", "Mechanism", "Rotor"]


class _Mechanisms(dict[str, Mechanism]):
    def __missing__(self, name: str) -> Mechanism:
        if not name.endswith(TORQUES_SUFFIX):
            raise KeyError(name)
        return with_torques(self[name.removesuffix(TORQUES_SUFFIX)])


MECHANISMS: dict[str, Mechanism] = _Mechanisms(
    (mechanism.name, mechanism)
    for mechanism in (PENDULUM, CART_POLE, DOUBLE_PENDULUM, FURUTA, REACTION_WHEEL, TRIPLE_PENDULUM)
)
"""All mechanisms by name; by a name that ends in ``TORQUES_SUFFIX`` also those with joint torques."""
