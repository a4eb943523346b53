"""Linearisation, design, controllers, estimators and disturbances for the torque-driven pendulum.

The core (everything but the ``*_node`` modules) knows no ROS and no clock: time and state are arguments.
"""
