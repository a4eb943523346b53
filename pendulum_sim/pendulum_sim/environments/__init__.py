"""Gymnasium environments of plants of any number of joints; importing this registers them all."""

from pendulum_sim.environments import environment

__all__ = ["environment"]
