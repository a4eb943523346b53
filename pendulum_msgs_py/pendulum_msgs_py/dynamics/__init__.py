"""Equations of motion as plain scalar functions.

Simulator, actuator emulator and identification call these very functions, interpreted or compiled by numba;
there is no second copy of an equation anywhere. They use ``math`` only and never allocate.
"""

from pendulum_msgs_py.dynamics.rigid import friction_magnitude, gravity_torque, rigid_acceleration, rigid_energy

__all__ = ["friction_magnitude", "gravity_torque", "rigid_acceleration", "rigid_energy"]
