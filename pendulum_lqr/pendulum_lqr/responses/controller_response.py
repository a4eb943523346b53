"""Frequency response of any controller, linearised by simulation.

A controller with integral, observer or optimisation has no gain to read off. In closed loop with its model, where
everything stays bounded, small multisines disturb the measured angle and, in a second run, velocity; the responses give

    u = -K y,  K = -U Y^-1  (U: 1 x 2, Y: 2 x 2 at each frequency)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.controller_interface.controller import controller_class, make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import DiscreteModel, discretise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["controller_response", "require_time_invariant"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_LENGTH = 20.0
"""Period of the excitation, with lines 0.05 Hz apart [s]."""
_MOST_PERIODS = 5
"""Periods after which a loop that is not periodic counts as unstable."""
_REPEATS = 1e-3
"""Largest change of the state per period, relative to its largest value, of a periodic loop."""
_ANGLE, _VELOCITY = 1e-4, 1e-2
"""Size of the excitation, small enough for limits to stay away [rad, rad/s]."""
_FALLEN = 0.5


def require_time_invariant(name: str) -> None:
    """Raise ParameterError for a controller that depends on time and so has no frequency response."""
    if not controller_class(name).TIME_INVARIANT:
        raise ParameterError(
            f"controller {name!r} answers by the time, and so has no frequency response; expected one that holds a "
            "set-point, such as lqr with the same q and r"
        )


def controller_response(
    name: str,
    plant: PlantParameters,
    frequency: ArrayLike,
    period: float,
    values: Mapping[str, object] | None = None,
    size: float = 1.0,
) -> tuple[Complex, bool]:
    """Return K at some frequencies, shape (2, n) [N m/rad, N m s/rad], and whether the loop with the model is stable.

    Frequencies (n,) [Hz] are below Nyquist, interpolated between lines 0.05 Hz apart; ``period`` in [s]; ``size``
    multiplies the disturbances of 0.1 mrad and 0.01 rad/s.

    Raises:
        ParameterError: No such controller, or not for this plant or period.
    """
    require_time_invariant(name)
    model = discretise(linearise(plant), period)
    samples = round(_LENGTH / period)
    lines = np.arange(1, samples // 2)
    generator = np.random.default_rng(1)
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.exp(2j * np.pi * generator.uniform(size=lines.size))
    wave = np.fft.irfft(spectrum, samples)
    wave /= np.abs(wave).max()
    wanted = np.asarray(frequency, dtype=np.float64)
    answers = np.empty((1, 2, lines.size), dtype=np.complex128)
    seen = np.empty((2, 2, lines.size), dtype=np.complex128)
    for run, scale in enumerate((_ANGLE, _VELOCITY)):
        controller = make_controller(name, plant, period, values)
        found = _closed_loop(controller, model, size * scale * wave, run, period)
        if found is None:
            return np.zeros((2, wanted.size), dtype=np.complex128), False
        effort, measured = found
        answers[0, run] = np.fft.rfft(effort)[lines]
        seen[:, run] = np.fft.rfft(measured, axis=1)[:, lines]
    inverse = np.linalg.inv(np.moveaxis(seen, 2, 0))
    K = -(np.moveaxis(answers, 2, 0) @ inverse)[:, 0, :]
    grid = lines / _LENGTH
    response = np.stack(
        [np.interp(wanted, grid, K[:, i].real) + 1j * np.interp(wanted, grid, K[:, i].imag) for i in (0, 1)]
    )
    return response, True


def _closed_loop(
    controller: Controller, model: DiscreteModel, wave: Array, channel: int, period: float
) -> tuple[Array, Array] | None:
    """Return torque and measurement over the last period, or None if the loop does not stay near upright."""
    size = wave.size
    state = np.zeros(model.A.shape[0])
    effort, measured = np.empty(size), np.empty((2, size))
    before = state.copy()
    largest = np.zeros_like(state)
    for turn in range(_MOST_PERIODS):
        for k in range(size):
            y = state[:2].copy()
            y[channel] += wave[k]
            try:
                u = controller.command((turn * size + k) * period, (float(y[0]), float(y[1])))
            except ArithmeticError as error:
                raise ParameterError(f"controller failed near upright: {error}") from error
            effort[k], measured[:, k] = u, y
            state = model.A @ state + model.B[:, 0] * u
            largest = np.maximum(largest, np.abs(state))
            if not abs(state[0]) < _FALLEN:
                return None
        # A stable loop under a periodic input becomes periodic; growth or drift does not.
        if turn and np.all(np.abs(state - before) <= _REPEATS * largest):
            return effort, measured
        before = state.copy()
    return None
