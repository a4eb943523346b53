"""Recordings of mechanisms, by an integrator of their own, and such of which one thing is spoiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from pendulum_bags.identification.identify import identify_joints
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

__all__ = ["MECHANISMS", "NOISE", "OFF", "PERIOD", "joint_verdict", "motion", "truth"]

PERIOD = 0.01
NOISE = 2e-4
DRIVE = {"double_pendulum": (1.0, 0.6), "acrobot": (0.0, 0.8), "cart_pole": (4.0, 0.0), "furuta": (0.01, 0.0)}
OFF = {
    "double_pendulum": {"inertia_1": 0.026, "centre_1": 0.17, "inertia_2": 0.055, "centre_2": 0.24},
    "acrobot": {"inertia_1": 0.029, "inertia_2": 0.055},
    "cart_pole": {"cart_mass": 1.3, "pole_inertia": 0.04, "cart.damping": 0.3},
    "furuta": {"pendulum_inertia": 1.6e-4, "arm_inertia": 1.8e-4},
}


def truth(name: str) -> PlantParameters:
    """Return a preset, with frictions where it has none."""
    plant = load_mechanism(name)
    if name == "cart_pole":
        return plant.with_values({"cart.damping": 0.5, "pole.damping": 0.003, "cart.coulomb_friction": 0.2})
    return plant


@cache
def motion(
    plant: PlantParameters, seed: int, seconds: float = 6.0, period: float = PERIOD, swing: float = 0.3
) -> JointRecording:
    """Return a noisy recording of a plant under slow multisines, by an integrator of its own with small steps."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(period * (1.0 + rng.uniform(-0.1, 0.1, round(seconds / period))))
    drives = DRIVE[plant.name]
    count = len(plant.joints)
    effort = np.zeros((time.size, count))
    for i, size in enumerate(drives):
        for rate in rng.uniform(0.4, 2.0, 4):
            effort[:, i] += 0.5 * size * np.sin(2.0 * np.pi * rate * time + rng.uniform(0.0, 6.3))
    friction = np.array([joint.coulomb_friction for joint in plant.joints])
    q, v = swing * rng.normal(0.0, 1.0, count), np.zeros(count)
    path = np.empty((time.size, count))
    path[0] = q
    for k in range(time.size - 1):
        h = (time[k + 1] - time[k]) / 8
        for step in range(8):
            torque = effort[k] + (step + 0.5) / 8 * (effort[k + 1] - effort[k])
            a = np.array(plant.acceleration(tuple(q), tuple(v), tuple(torque - friction * np.tanh(v / 0.02))))
            middle = v + 0.5 * h * a
            half = q + 0.5 * h * v
            a = np.array(
                plant.acceleration(tuple(half), tuple(middle), tuple(torque - friction * np.tanh(middle / 0.02)))
            )
            q, v = q + h * middle, v + h * a
        path[k + 1] = q
    noisy = path + rng.normal(0.0, NOISE, path.shape)
    return JointRecording(f"{plant.name}_{seed}.csv", time, noisy, effort, ("linear",) * count, f"{plant.name}_{seed}")


def _changed(
    position: tuple[tuple[float, float], ...] = ((1, 0), (0, 1)),
    effort: tuple[float, float] = (1, 1),
    shift: tuple[float, float] = (0, 0),
) -> Callable[[JointRecording], JointRecording]:
    return lambda r: replace(r, position=r.position @ np.array(position).T + shift, effort=r.effort * effort)


MECHANISMS: dict[str, tuple[str, str | None, Callable[[JointRecording], JointRecording]]] = {
    "both exchanged": (
        "double_pendulum",
        "columns of shoulder and elbow exchanged",
        lambda r: replace(r, position=r.position[:, ::-1], effort=r.effort[:, ::-1]),
    ),
    "both negated": ("double_pendulum", "every effort negated", _changed(effort=(-1, -1))),
    "elbow negated": ("double_pendulum", "the effort of elbow negated", _changed(effort=(1, -1))),
    "elbow against the world": (
        "double_pendulum",
        "the angle of elbow less that of shoulder",
        _changed(((1, 0), (1, 1))),
    ),
    "milli": ("double_pendulum", "every effort in m", _changed(effort=(1e3, 1e3))),
    "degrees": ("double_pendulum", "in degrees", _changed(((57.29578, 0), (0, 57.29578)))),
    "shoulder from upright": (
        "double_pendulum",
        "the angle of shoulder measured from the opposite direction",
        _changed(shift=(np.pi, 0)),
    ),
    "cart and pole exchanged": ("cart_pole", "columns of cart and pole exchanged", _changed(((0, 1), (1, 0)))),
    "cart negated": ("cart_pole", "the effort of cart negated", _changed(effort=(-1, 1))),
    "pole from upright": (
        "cart_pole",
        "the angle of pole measured from the opposite direction",
        _changed(shift=(0, np.pi)),
    ),
    "nothing, two driven": ("double_pendulum", None, _changed()),
    "nothing, one driven": ("cart_pole", None, _changed()),
}
"""What is spoiled: of which mechanism, the words that are to name it, and how."""


def joint_verdict(name: str, seed: int) -> tuple[str, str]:
    """Return ``named``, ``accepted`` or what else became of a spoiled recording, and what is said of it."""
    mechanism, words, spoiled = MECHANISMS[name]
    plant = truth(mechanism)
    try:
        result = identify_joints(plant, [spoiled(motion(plant, seed))], extras="friction")
    except PendulumError as error:
        said, refused = str(error), True
    else:
        said, refused = result.sentences()[0], result.refused
    if words is None:
        return ("refused" if refused else "accepted"), said
    others = {one for _, one, _ in MECHANISMS.values() if one and one not in words and one in said}
    return ("named" if refused and words in said and not others else " ".join(others) or "none"), said
