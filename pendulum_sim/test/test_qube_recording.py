"""The preset ``qube_servo`` against a recording of a real QUBE-Servo, whose voltages were recorded."""

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

PERIOD = 0.002
WINDOW = 50
"""Samples of a prediction: 0.1 s, over which an upright pendulum's errors grow by exp(1.2)."""


def test_it_predicts_a_real_one_over_a_tenth_of_a_second_by_the_vendors_figures_alone(shared_data: Path) -> None:
    (file,) = (shared_data / "qube_upright").glob("*.csv")
    columns = np.genfromtxt(file, delimiter=",", names=True)
    # The recording's pendulum angle grows against the arm's direction, from upright.
    motion = np.stack([columns["theta"], np.pi - columns["alpha"]], axis=1)
    slopes = savgol_filter(motion, 15, 3, deriv=1, delta=PERIOD, axis=0)
    plant, squares = MechanismPlant(load_mechanism("qube_servo"), PERIOD), []
    for first in np.linspace(600, len(motion) - WINDOW - 1, 25).astype(int):
        seen = motion[first : first + WINDOW]

        def errors(start: np.ndarray, first: int = first, seen: np.ndarray = seen) -> np.ndarray:
            plant.reset(tuple(start[:2]), tuple(start[2:]))
            volts = columns["plant_input"][first : first + WINDOW - 1]
            path = [start[:2], *(plant.step((float(u),)).position for u in volts)]
            found: np.ndarray = (np.array(path) - seen).ravel()
            return found

        # Velocities were not measured: each window's start is fitted, nothing else.
        fitted = least_squares(errors, [*seen[0], *slopes[first]], max_nfev=6)
        squares.append(fitted.fun.reshape(-1, 2) ** 2)
    arm, pendulum = np.sqrt(np.mean(np.concatenate(squares), axis=0))
    # Arm 5.4, pendulum 5.6 mrad; the encoders' step is 3.1 mrad.
    assert arm < 6.0e-3
    assert pendulum < 6.2e-3
