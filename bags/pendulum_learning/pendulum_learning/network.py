"""Dense networks that learn: forward, backward, and Adam, in numpy and single precision."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Floats

__all__ = ["Adam", "Mlp"]


class Mlp:
    """Dense layers with tanh between them and a linear last one."""

    def __init__(self, sizes: Sequence[int], generator: np.random.Generator, last: float = 1.0) -> None:
        self.parameters: list[Floats] = []
        count = len(sizes) - 1
        for k, (before, after) in enumerate(pairwise(sizes)):
            scale = (last if k == count - 1 else 1.0) / math.sqrt(before)
            self.parameters.append((scale * generator.standard_normal((before, after))).astype(np.float32))
            self.parameters.append(np.zeros(after, dtype=np.float32))
        self._inputs: list[Floats] = []
        self._buffers: dict[tuple[str, int, int], Floats] = {}

    def forward(self, x: Floats) -> Floats:
        """Return outputs (n, out) for inputs (n, in), and store what :meth:`backward` needs."""
        self._inputs = []
        last = len(self.parameters) - 2
        for k in range(0, last, 2):
            self._inputs.append(x)
            x = np.matmul(x, self.parameters[k], out=self._room("values", k, x, self.parameters[k + 1].size))
            x += self.parameters[k + 1]
            np.tanh(x, out=x)
        self._inputs.append(x)
        x = x @ self.parameters[last]
        x += self.parameters[last + 1]
        return x

    def backward(self, slope: Floats) -> list[Floats]:
        """Return a loss's derivatives by the parameters from that by the last output, shape (n, out)."""
        gradients: list[Floats] = []
        for k in range(len(self.parameters) - 2, -1, -2):
            x = self._inputs[k // 2]
            gradients += [slope.sum(axis=0), x.T @ slope]
            if k:
                slope = np.matmul(slope, self.parameters[k].T, out=self._room("slopes", k, slope, x.shape[1]))
                square = np.multiply(x, x, out=self._room("squares", 0, x, x.shape[1]))
                slope *= np.subtract(np.float32(1.0), square, out=square)
        return gradients[::-1]

    def _room(self, what: str, layer: int, like: Floats, width: int) -> Floats:
        """Return a reused array of ``like``'s rows and type: fresh memory costs more than the product that fills it."""
        key = (f"{what} {layer}", len(like), width)
        if key not in self._buffers or self._buffers[key].dtype != like.dtype:
            self._buffers[key] = np.empty((len(like), width), dtype=like.dtype)
        return self._buffers[key]


class Adam:
    """Adam that changes ``parameters`` in place, with gradients cut to the length ``longest`` [-].

    Source: Kingma and Ba, Adam: a method for stochastic optimization, 2015, algorithm 1.
    """

    def __init__(self, parameters: Sequence[Floats], longest: float = 1.0) -> None:
        self.parameters = parameters
        self.longest = longest
        self.count = 0
        self.first = [np.zeros_like(each) for each in parameters]
        self.second = [np.zeros_like(each) for each in parameters]

    def step(self, gradients: Sequence[Floats], rate: float) -> None:
        """Take a step at the learning rate ``rate``."""
        length = math.sqrt(sum(float(np.sum(np.square(each, dtype=np.float64))) for each in gradients))
        cut = min(1.0, self.longest / (length + 1e-12))
        self.count += 1
        size = rate * math.sqrt(1.0 - 0.999**self.count) / (1.0 - 0.9**self.count)
        for k, gradient in enumerate(gradients):
            g, m, v = gradient * np.float32(cut), self.first[k], self.second[k]
            np.add(m, np.float32(0.1) * (g - m), out=m)
            np.add(v, np.float32(0.001) * (g * g - v), out=v)
            value = self.parameters[k]
            np.subtract(value, np.float32(size) * m / (np.sqrt(v) + np.float32(1e-7)), out=value)

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays of a checkpoint."""
        state: dict[str, NDArray[np.generic]] = {"count": np.array(self.count)}
        for k, (m, v) in enumerate(zip(self.first, self.second, strict=True)):
            state[f"first_{k}"], state[f"second_{k}"] = m, v
        return state

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Resume from a checkpoint."""
        self.count = int(state["count"])
        for k in range(len(self.parameters)):
            self.first[k][...] = state[f"first_{k}"]
            self.second[k][...] = state[f"second_{k}"]
