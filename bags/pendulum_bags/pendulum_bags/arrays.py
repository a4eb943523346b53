"""Types of arrays shared by all subpackages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Complex", "Floats"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Floats = NDArray[np.float32]
