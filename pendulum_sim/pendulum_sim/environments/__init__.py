"""Gymnasium environments of plants of one joint and of several; importing this registers them all."""

from pendulum_sim.environments import environment, mechanism_environment

__all__ = ["environment", "mechanism_environment"]
