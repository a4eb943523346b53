"""Inner loop of the emulator: motor, gears, spring, link, temperatures and firmware in steps of 0.25 ms.

It calls the equations of :mod:`pendulum_msgs_py.dynamics.series_elastic`. Semi-implicit Euler: velocities first, then
positions with the new velocities; dry friction implicitly, hysteresis exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

import pendulum_msgs_py.dynamics.joint_torques as _torques
import pendulum_msgs_py.dynamics.rigid as _rigid
import pendulum_msgs_py.dynamics.series_elastic as _sea
from pendulum_hw_bridge.emulation import thermal as _thermal
from pendulum_hw_bridge.emulation.firmware import CONTROL_PERIOD, Array, control_pwm
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.loops.machine_code import Loop, NoMachineCodeError, load_loop
from pendulum_msgs_py.loops.records import structure_of
from pendulum_msgs_py.plants.friction_terms import TERM_PARAMETERS, added_friction
from pendulum_msgs_py.programs.kernel_cache import keep_kernel

__all__ = ["CONSTANTS", "LAYOUT", "STATES", "STEP", "STEPS_PER_CYCLE", "STEP_NS", "Actuator", "advance"]

STEP = 2.5e-4
"""Integration step [s]."""
STEP_NS = 250_000
"""Integration step [ns]."""
STEPS_PER_CYCLE = round(CONTROL_PERIOD / STEP)

STATES = (
    "motor_position", "motor_velocity", "position", "velocity", "hysteresis", "winding_temperature",
    "housing_temperature", "body_temperature", "pwm", "current", "spring_torque", "heat",
)  # fmt: skip
"""Entries of the state vector, at the output side of the gears; ``heat`` sums i^2 R [J]."""

CONSTANTS = (
    "gear_ratio", "torque_constant", "back_emf_constant", "winding_resistance", "resistance_coefficient",
    "magnet_coefficient", "supply_voltage", "reflected_inertia", "motor_damping", "motor_coulomb", "motor_static",
    "motor_stribeck", "stiffness", "hardening", "hysteresis_torque", "hysteresis_deflection", "link_inertia",
    "link_damping", "gravity", "link_coulomb", "link_static", "link_stribeck", "winding_housing", "housing_body",
    "body_ambient", "winding_capacity", "housing_capacity", "body_capacity", "ambient", "max_winding",
    "critical_winding", "effort_normaliser", "velocity_normaliser", "velocity_clamp", "effort_clamp", "position_min",
    "position_max", "pwm_limit", "pwm_step", "enabled", *TERM_PARAMETERS, *JOINT_TORQUES,
)  # fmt: skip
"""Entries of the constant vector."""

_QM, _VM, _Q, _V, _Z, _TW, _TH, _TB, _PWM, _I, _TAU, _HEAT = range(12)
(
    _N, _KT, _KE, _R20, _ALPHA, _BETA, _VOLT, _J, _BV, _TC, _TS, _VS, _K, _K3, _TAUH, _D0, _M, _BL, _G, _LTC, _LTS,
    _LVS, _RWH, _RHB, _RBA, _CW, _CH, _CB, _AMBIENT, _TMAX, _TCRIT, _FF_EFFORT, _FF_VELOCITY, _VCLAMP, _ECLAMP, _QMIN,
    _QMAX, _ULIMIT, _USTEP, _ENABLED,
) = range(len(CONSTANTS) - len(TERM_PARAMETERS) - len(JOINT_TORQUES))  # fmt: skip
_DRAG, _COS_2, _SIN_2, _COS_3, _SIN_3 = range(len(CONSTANTS) - len(JOINT_TORQUES), len(CONSTANTS))

_CLAMP_BAND = 0.05
"""Share of the velocity clamp over which the firmware reduces the duty to zero [-]."""

# Module-level names, by which the compiler finds the functions.
_resistance_at = _sea.winding_resistance_at
_winding_current = _sea.winding_current
_spring_torque = _sea.spring_torque
_dahl_step = _sea.dahl_step
_motor_acceleration = _sea.motor_acceleration
_dry_friction_step = _sea.dry_friction_step
_link_acceleration = _sea.link_acceleration
_gravity_torque = _rigid.gravity_torque
_friction_magnitude = _rigid.friction_magnitude
_joint_torque = _torques.joint_torque
_added_friction = added_friction(CONSTANTS)
_constant_at = _thermal.torque_constant_at

LAYOUT = np.dtype(
    [
        ("state", "f8", (len(STATES),)),
        ("constants", "f8", (len(CONSTANTS),)),
        ("gains", "f8", (3, 14)),
        ("memory", "f8", (3, 5)),
        ("setpoints", "f8", (3,)),
        ("link_torque", "f8"),
        ("strategy", "i8"),
        ("first_step", "i8"),
        ("steps", "i8"),
    ],
    align=True,
)
"""Arguments of :func:`advance` in the memory of the compiled loop."""


class Actuator:
    """State of the emulated actuator in one block of memory, stepped by machine code if available.

    Otherwise numba compiles the same function in this process, or Python runs it, with identical bits. Its arrays are
    arguments of :func:`advance`.
    """

    def __init__(self) -> None:
        self._whole = np.zeros(1, LAYOUT)
        entries = self._whole[0]
        self.state: Array = entries["state"]
        self.constants: Array = entries["constants"]
        self.gains: Array = entries["gains"]
        self.memory: Array = entries["memory"]
        self.setpoints: Array = entries["setpoints"]
        # Arguments that change with each call: numpy would take several times as long.
        self._numbers: Any = structure_of(LAYOUT).from_buffer(self._whole.data)
        self._loop = _machine_code()

    def advance(self, strategy: int, link_torque: float, first_step: int, steps: int) -> None:
        """Advance by some steps; arguments as of :func:`advance`."""
        if self._loop is None:
            arrays = (self.state, self.constants, self.gains, self.memory, self.setpoints)
            _elsewhere()(*arrays, strategy, link_torque, first_step, steps)
            return
        numbers = self._numbers
        numbers.strategy, numbers.link_torque = strategy, link_torque
        numbers.first_step, numbers.steps = first_step, steps
        self._loop(self._whole)


@cache
def _machine_code() -> Loop | None:
    try:
        return load_loop("pendulum_hw_bridge.emulation.kernel_loop:actuator_loop", symbols={})
    except NoMachineCodeError:
        return None


@cache
def _elsewhere() -> Callable[..., None]:
    try:
        import numba  # noqa: F401  (what compiles asks for it)
    except ImportError:
        return advance
    from pendulum_msgs_py.loops.trees import compile_tree

    compiled = compile_tree(advance, exact=True, inline=True)
    kept: Callable[..., None] = keep_kernel(compiled, "emulated_actuator")
    return kept


def advance(
    state: Array,
    constants: Array,
    gains: Array,
    memory: Array,
    setpoints: Array,
    strategy: int,
    link_torque: float,
    first_step: int,
    steps: int,
) -> None:
    """Advance the emulated actuator and its link by some steps, in place.

    Args:
        state: Entries as in :data:`STATES`.
        constants: Entries as in :data:`CONSTANTS`.
        gains: (3, 14), see :mod:`.firmware`.
        memory: (3, 5), of the firmware's loops.
        setpoints: Position, velocity, effort (or PWM); NaN for off.
        strategy: 0 to 4.
        link_torque: External torque on the link, constant over the steps [N m].
        first_step: Number of the first step since power-up: the firmware runs every fourth.
        steps: Number of steps.
    """
    period = STEP * STEPS_PER_CYCLE
    for number in range(first_step, first_step + steps):
        deflection = state[_QM] - state[_Q]
        if number % STEPS_PER_CYCLE == 0:
            sensed = _spring_torque(deflection, 0.0, constants[_K], constants[_K3], 0.0)
            asked = setpoints[2]
            if not math.isnan(asked) and strategy != 1 and abs(asked) > constants[_ECLAMP]:
                setpoints[2] = math.copysign(constants[_ECLAMP], asked)
            pwm = control_pwm(
                strategy,
                gains,
                memory,
                setpoints,
                state[_Q],
                state[_V],
                sensed,
                constants[_FF_EFFORT],
                constants[_FF_VELOCITY],
                period,
            )
            setpoints[2] = asked
            pwm = min(max(pwm, -constants[_ULIMIT]), constants[_ULIMIT])
            if pwm * state[_VM] > 0.0:
                # The firmware reduces the duty as the motor nears its speed limit.
                room = (constants[_VCLAMP] - abs(state[_VM])) / (_CLAMP_BAND * constants[_VCLAMP])
                pwm *= min(max(room, 0.0), 1.0)
            if (state[_Q] > constants[_QMAX] and pwm > 0.0) or (state[_Q] < constants[_QMIN] and pwm < 0.0):
                pwm = 0.0
            if state[_TW] > constants[_TCRIT]:
                cool = (constants[_TMAX] - state[_TW]) / (constants[_TMAX] - constants[_TCRIT])
                pwm *= min(max(cool, 0.0), 1.0)
            if constants[_ENABLED] == 0.0:
                pwm = 0.0
            state[_PWM] = math.floor(pwm / constants[_USTEP] + 0.5) * constants[_USTEP]
        resistance = _resistance_at(state[_TW], constants[_R20], constants[_ALPHA])
        current = _winding_current(
            state[_PWM],
            state[_VM],
            constants[_VOLT],
            _constant_at(state[_TH], constants[_KE], constants[_BETA]),
            constants[_N],
            resistance,
        )
        spring = _spring_torque(deflection, state[_Z], constants[_K], constants[_K3], constants[_TAUH])
        motor_velocity = state[_VM] + STEP * _motor_acceleration(
            current,
            state[_VM],
            spring,
            _constant_at(state[_TH], constants[_KT], constants[_BETA]),
            constants[_N],
            constants[_BV],
            constants[_J],
        )
        friction = _friction_magnitude(state[_VM], constants[_TC], constants[_TS], constants[_VS])
        motor_velocity = _dry_friction_step(motor_velocity, friction, constants[_J], STEP)
        own = 0.0
        drag, cos_2, sin_2 = constants[_DRAG], constants[_COS_2], constants[_SIN_2]
        cos_3, sin_3 = constants[_COS_3], constants[_SIN_3]
        if drag != 0.0 or cos_2 != 0.0 or sin_2 != 0.0 or cos_3 != 0.0 or sin_3 != 0.0:
            own = _joint_torque(state[_Q], state[_V], drag, cos_2, sin_2, cos_3, sin_3)
        velocity = state[_V] + STEP * _link_acceleration(
            state[_Q], state[_V], spring, link_torque + own, constants[_M], constants[_BL], constants[_G]
        )
        added = _added_friction(abs(state[_V]), abs(_gravity_torque(state[_Q], constants[_G])), constants)
        friction = _friction_magnitude(state[_V], constants[_LTC] + added, constants[_LTS] + added, constants[_LVS])
        velocity = _dry_friction_step(velocity, friction, constants[_M], STEP)
        state[_VM] = motor_velocity
        state[_V] = velocity
        state[_QM] += STEP * motor_velocity
        state[_Q] += STEP * velocity
        state[_Z] = _dahl_step(state[_Z], state[_QM] - state[_Q] - deflection, constants[_D0])
        state[_I] = current
        state[_TAU] = spring
        power = current * current * resistance
        state[_HEAT] += STEP * power
        to_housing = (state[_TW] - state[_TH]) / constants[_RWH]
        to_body = (state[_TH] - state[_TB]) / constants[_RHB]
        to_ambient = (state[_TB] - constants[_AMBIENT]) / constants[_RBA]
        state[_TW] += STEP * (power - to_housing) / constants[_CW]
        state[_TH] += STEP * (to_housing - to_body) / constants[_CH]
        state[_TB] += STEP * (to_body - to_ambient) / constants[_CB]
