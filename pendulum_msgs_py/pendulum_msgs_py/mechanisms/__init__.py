"""Mechanisms: equations of motion of one joint or several, each in one file and one line of ``MECHANISMS``."""

from pendulum_msgs_py.mechanisms.cart_pole import CART_POLE
from pendulum_msgs_py.mechanisms.double_pendulum import DOUBLE_PENDULUM
from pendulum_msgs_py.mechanisms.furuta import FURUTA
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Rotor
from pendulum_msgs_py.mechanisms.pendulum import PENDULUM
from pendulum_msgs_py.mechanisms.reaction_wheel import REACTION_WHEEL
from pendulum_msgs_py.mechanisms.triple_pendulum import TRIPLE_PENDULUM

__all__ = ["MECHANISMS", "Body", "Mechanism", "Rotor"]

MECHANISMS: dict[str, Mechanism] = {
    mechanism.name: mechanism
    for mechanism in (PENDULUM, CART_POLE, DOUBLE_PENDULUM, FURUTA, REACTION_WHEEL, TRIPLE_PENDULUM)
}
"""All mechanisms by name."""
