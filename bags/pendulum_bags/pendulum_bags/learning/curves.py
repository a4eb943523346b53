"""The curves of a training as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.learning.training import Training

__all__ = ["write_curves"]


def write_curves(out: Path, settings: Training, curves: NDArray[np.float64]) -> Path:
    """Draw reward and spread of actions over steps, beside the policy file, and return the path.

    Args:
        out: The policy file.
        settings: What was trained.
        curves: As :func:`pendulum_bags.learning.training.train` returns them, shape (n, 4).
    """
    million, reward, _, spread = curves.T
    million = million / 1e6
    title = f"Training of {settings.task} on {settings.plant.name}, seed {settings.seed}"
    figure = Figure(
        f"{out.stem}_training",
        title,
        f"Mean reward a step over {settings.steps / 1e6:.2g} million steps.",
        [
            Panel("steps [million]", "mean reward a step [-]", [Trace(million, reward, "", "sim")]),
            Panel("steps [million]", "spread of actions [-]", [Trace(million, spread, "", "difference")]),
        ],
        stacked=True,
    )
    return write_figures([figure], out.parent, formats=("png",))[0]
