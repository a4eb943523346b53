"""The emulated machine has the simulator's mechanics: without lag and delay of its drives, the two move as one."""

from __future__ import annotations

import numpy as np
import pytest

from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

_MILLISECOND = 1_000_000
INSTANT = QuasiDirectDrive(current_loop=0.0, command_delay=0.0, feedback_delay=0.0)


@pytest.mark.parametrize("plant", ["cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta", "qube_servo"])
def test_without_lag_and_delay_it_moves_as_the_simulated_plant_does(plant: str) -> None:
    parameters = load_mechanism(plant)
    start = tuple(0.3 if joint.turns else 0.1 for joint in parameters.coordinates.joints)
    machine, simulated = EmulatedMachine(parameters, INSTANT, position=start), MechanismPlant(parameters, 1e-3)
    simulated.reset(start)
    for index in range(len(machine.drives)):
        machine.switch(index, 0, on=True)
    generator = np.random.default_rng(3)
    for step in range(300):
        if step % 10 == 0:
            shares = [float(generator.uniform(-1.5, 1.5)) for _ in machine.drives]
            effort = tuple(share * limit for share, limit in zip(shares, parameters.command_limits, strict=True))
            for index, share in enumerate(shares):
                # Of a motor in volts the setpoint is a duty.
                machine.deliver(index, share * machine.largest[index], step * _MILLISECOND)
        state = simulated.step(effort)
        machine.advance_to((step + 1) * _MILLISECOND - 1)
        machine.advance_to((step + 1) * _MILLISECOND, wholly=True)
        position, velocity, _ = machine.state
        assert position == pytest.approx(state.position, abs=1e-7)
        assert velocity == pytest.approx(state.velocity, abs=1e-6)
