"""Equations of motion as plain scalar functions.

Simulator, emulator and identification call these very functions, interpreted or compiled by numba: no equation exists
twice. They use ``math`` only and never allocate.
"""

from pendulum_msgs_py.dynamics.rigid import friction_magnitude, gravity_torque, rigid_acceleration, rigid_energy

__all__ = ["friction_magnitude", "gravity_torque", "rigid_acceleration", "rigid_energy"]
