"""What a user must know of a mechanism's fit beside its figures, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_doubt import Score
from pendulum_bags.identification.mechanism_fit import MechanismFit
from pendulum_bags.identification.mechanism_model import DELAY
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.wording import Interval
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["notes_of"]

_WIDE = 0.5
"""Half width over value from which on the recordings do not determine a parameter."""


def notes_of(
    plant: MechanismParameters,
    found: MechanismFit,
    recordings: Sequence[JointRecording],
    intervals: Mapping[str, Interval],
    training: Mapping[str, Score],
    *,
    held: Sequence[str] = (),
    pushed: Sequence[tuple[str, float, float]] = (),
) -> list[str]:
    """Return what there is to say of a fit, most important first.

    Args:
        plant: The start.
        found: The fit.
        recordings: Its data.
        intervals: By name.
        training: Scores of the recordings, by name.
        held: Sizes that they do not determine.
        pushed: Windows left out: recording, start and end from its first sample [s].
    """
    model = found.model
    notes = [
        f"{r.name}: {r.left_out} rows with a NaN or a repeated stamp are left out." for r in recordings if r.left_out
    ]
    passive = {joint for r in recordings for joint in r.passive_effort}
    if passive:
        notes.append(
            f"The plant has no actuator at {', '.join(sorted(passive))}, yet an effort was recorded there: the fit "
            "counts it as acting."
        )
    if pushed:
        listing = ", ".join(f"{name} from {first:.2f} to {last:.2f} s" for name, first, last in pushed)
        notes.append(f"Left out, since something that was not recorded moves the machine there: {listing}.")
    if held:
        notes.append(
            f"The recordings do not determine {', '.join(held)}: held at the starting plant's value, without interval."
        )
    worst = max(score.share for score in training.values())
    if worst > DOUBTFUL_SHARE:
        notes.append(
            f"{INCOMPLETE}: the model misses up to {100.0 * worst:.0f} % of what straight lines miss: something acts "
            "on the machine that it has no word for."
        )
    none = [n for n in found.free if model.lowest(n) == 0.0 and intervals[n].low <= 0.0]
    if none:
        listing = ", ".join(f"{n} (up to {intervals[n].high:.3g} {model.unit(n)})" for n in none)
        notes.append(f"Not determined, may be 0: {listing}.")
    loose = [
        n
        for n in found.free
        if n not in none and n != DELAY and not n.endswith("_offset") and intervals[n].relative > _WIDE
    ]
    if loose:
        listing = ", ".join(f"{n} (+-{100.0 * min(intervals[n].relative, 99.0):.0f} %)" for n in loose)
        notes.append(f"The recordings do not determine {listing}.")
    if any(n.endswith("coulomb_friction") and intervals[n].low > 0.0 for n in found.free):
        notes.append(
            "The plant has dry friction: in trials with such plants, held upright, 72 to 92 % of the values lay in "
            "their 95 % intervals, fewest of lengths, inertias, delay and lag."
        )
    notes.extend(_ridge(found))
    own = [spec.name for spec in plant.mechanism.parameters]
    held = [name for name in own if name not in found.free]
    notes.append(
        "Held at the values of the plant file, as known or since no motion tells them from the others: "
        f"{', '.join(held)}. Where one of them is wrong, the fitted ones carry its error."
    )
    if DELAY in found.free and model[DELAY] < 0.0:
        notes.append(
            f"The recorded effort comes {-1e3 * model[DELAY]:.2g} ms after its effect (a filter in its measurement?); "
            "the plant file has no such delay."
        )
    if any(name.endswith("effort_offset") for name in found.free):
        listing = ", ".join(f"{n} {model[n]:+.3g} {model.unit(n)}" for n in found.free if n.endswith("effort_offset"))
        notes.append(f"The recorded efforts have offsets, which the plant file leaves out: {listing}.")
    return notes


def _ridge(found: MechanismFit) -> list[str]:
    """Return in words the direction that the data see least, where it is far weaker than the others."""
    size = np.array([max(abs(found.model[name]), 1e-2 * found.model.size(name)) for name in found.free])
    matrix = sum((b.matrices.sum(axis=0) for b in found.blocks), np.zeros((len(size),) * 2)) * np.outer(size, size)
    values, vectors = np.linalg.eigh(matrix)
    samples = sum(b.samples for b in found.blocks)
    error = float(np.sqrt(found.cost / max(samples, 1) / max(values[0], 1e-300)))
    if error < 0.02:
        return []
    direction = vectors[:, 0] / np.max(np.abs(vectors[:, 0]))
    big = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.25]
    if len(big) < 2:
        return []
    told = ", ".join(f"{found.free[i]} by {100.0 * direction[i] * np.sign(direction[big[0]]):+.0f} %" for i in big)
    return [f"The motion hardly changes when these change together: {told}."]
