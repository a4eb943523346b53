"""Linearisation, design, controllers, estimators and disturbances for torque-driven pendulums.

Everything but the ``*_node`` modules is independent of ROS and clocks: time and state are arguments.
"""
