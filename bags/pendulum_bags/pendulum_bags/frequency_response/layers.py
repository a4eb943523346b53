"""Two layers of the verdict from measured responses: is it the same plant, and which controllers carry over?"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pendulum_bags.frequency_response.compare import SMALLEST, Difference
from pendulum_bags.frequency_response.designs import DesignResult
from pendulum_bags.verdict import Evidence, Layer, LayerResult, Mark
from pendulum_lqr.responses.certificate import Certifier
from pendulum_lqr.responses.machine_response import LEAST_DAMPING
from pendulum_lqr.responses.measured_response import MeasuredResponse

__all__ = ["GAP_MARGIN", "LONGER", "same_plant", "which_controllers"]

GAP_MARGIN = 0.2
"""Gap that does not matter: a loop with a larger margin b(P, K), as an LQR on this plant has, stays stable."""
_CLOSE = {True: "close enough for feedback, not identical", False: "close enough for feedback"}
"""By whether a difference at single frequencies was found."""
_WEAK_COHERENCE = 0.5
_FEW = 2
_UNSTABLE = 1e-6
"""Real part above which a pole of a model counts as unstable [1/s]: poles at 0 are computed with an error."""
LONGER = "python -m pendulum_bags experiment frequency_response --periods 40"
"""Measures the thesis's plant longer than by default."""


def same_plant(
    first: MeasuredResponse,
    second: MeasuredResponse,
    difference: Difference,
    margin: float = GAP_MARGIN,
    *,
    longer: str = LONGER,
) -> LayerResult:
    """Return layer 2; ``margin`` is the gap that does not matter, ``longer`` the command that measures longer."""
    gap = difference.nu_gap
    mark = Mark.YES if gap.high < margin else Mark.NO if gap.low > margin else Mark.UNDECIDED
    where = f"largest at {difference.gap_at:.2g} Hz"
    total = difference.frequency.size
    found = (
        f"a difference above {100.0 * SMALLEST:g} % was found at {difference.lines_that_differ} of {total} frequencies"
        if difference.found
        else f"no difference above {100.0 * SMALLEST:g} % was found at any frequency"
    )
    size = f"nu-gap {gap.value:.3f}, 95 % interval {gap.low:.3f} to {gap.high:.3f}, {margin:.2g} allowed"
    heads = {
        Mark.YES: f"Simulation and hardware are {_CLOSE[difference.found]} ({size})",
        Mark.NO: f"Simulation and hardware are not close enough for feedback ({size})",
        Mark.UNDECIDED: f"Whether simulation and hardware are close enough for feedback is open ({size})",
    }
    sentence = f"{heads[mark]}, {where}; {found}."
    delay, gain = difference.delay, difference.gain
    shown = Mark.YES if mark is Mark.YES else Mark.UNDECIDED
    evidence = [
        Evidence(
            "nu-gap", "", gap.value, gap.low, gap.high, f"below {margin:.2g}", mark,
            f"at the measured frequencies, blind to a resonance between two. {difference.scaling.sentence()}",
        ),
        Evidence(
            "extra delay of the hardware", "ms", 1e3 * delay.value, 1e3 * delay.low, 1e3 * delay.high, "", shown,
            "slope of the phase over all frequencies; lag and spring count too",
        ),
        Evidence("gain of the hardware relative to the simulation", "", gain.value, gain.low, gain.high, "", shown),
        Evidence(
            f"frequencies that differ by more than {100.0 * SMALLEST:g} %", "", float(difference.lines_that_differ),
            None, None, "", shown, f"of {total}; error 5 % over all",
        ),
    ]  # fmt: skip
    for measured, name in ((first, "simulation"), (second, "hardware")):
        weakest = float(measured.coherence[measured.driven].min())
        note = "" if weakest > _WEAK_COHERENCE else "weak: a larger amplitude or more periods would be more informative"
        evidence.append(Evidence(f"lowest coherence, {name}", "", weakest, mark=shown, note=note))
        if measured.distortion[1] == measured.distortion[1]:
            evidence.append(
                Evidence(
                    f"distortion, {name}",
                    "%",
                    100.0 * measured.distortion[1],
                    mark=shown,
                    note="velocity on lines that were not excited: friction and other nonlinearity",
                )
            )
    steps: tuple[str, ...] = ()
    if mark is Mark.NO:
        steps = ("identify delay, gain and friction on the hardware (python -m pendulum_bags identify)",)
    elif mark is Mark.UNDECIDED:
        steps = (f"measure longer: {longer}",)
    reasons = {
        Mark.YES: f"the plants are {_CLOSE[difference.found]} (nu-gap at most {gap.high:.2g}, {margin:.2g} allowed)",
        Mark.NO: f"the plants are {gap.value:.2f} apart in the nu-gap ({margin:.2g} allowed), {where}",
        Mark.UNDECIDED: f"the nu-gap, {gap.low:.2f} to {gap.high:.2f}, is measured too roughly ({margin:.2g} allowed)",
    }
    return LayerResult(Layer.SAME_PLANT, mark, sentence, tuple(evidence), steps, reasons[mark])


def which_controllers(certifier: Certifier, designs: Sequence[DesignResult], *, longer: str = LONGER) -> LayerResult:
    """Return layer 3: yes if all designs that the simulation accepts carry over; ``longer`` adds data."""
    profile = certifier.profile
    unstable = int(np.sum(np.linalg.eigvals(certifier.plant.A).real > _UNSTABLE))
    good = [design for design in designs if design.certified]
    damping = max(LEAST_DAMPING, *(design.certificate.hidden_damping for design in good), 0.0)
    rejected = [design for design in designs if design.rejected]
    bad = [design for design in designs if not (design.certified or design in rejected)]
    mark = Mark.YES if good and not bad else Mark.UNDECIDED if all(design.undecided for design in bad) else Mark.NO
    count = len(designs)
    rows, not_rows, own_rows = (
        ", ".join(f"row {i}" for i, design in enumerate(designs, 1) if design in some) for some in (good, bad, rejected)
    )
    limit = (
        f"designs with a margin b above {profile.value_upper:.2f} stabilise the hardware too"
        if profile.value_upper < 1.0
        else "the gap certifies no design by its margin alone"
    )
    if good and (bad or rejected):
        verdict = f"of {count} designs {rows}" + (f"; not {not_rows}" if bad else "")
    elif good:
        verdict = f"all {count} designs" if count > 1 else "the design"
    else:
        verdict = f"none of {count} designs"
    if rejected:
        verdict += f"; unstable on the model already: {own_rows}"
    evidence = [
        Evidence(
            "nu-gap of model and hardware",
            "",
            profile.value,
            None,
            profile.value_upper,
            "",
            mark,
            f"upper 95 % limit, largest at {profile.at:.2g} Hz",
        ),
        *(_row(design, profile.value_upper) for design in designs),
    ]
    steps = tuple(
        f"redesign {design.name} with more margin, or identify the hardware and design again"
        for design in bad
        if not design.undecided
    )
    steps += tuple(
        f"record {design.name} on simulator and emulator: python -m pendulum_bags experiment thesis --controller "
        "FILE.npz"
        for design in bad
        if design.unknown
    )
    # Due to the start of the measurement, not to its error.
    slow = [design.certificate.unseen for design in bad if design.certificate.undecided and design.certificate.unseen]
    open_ = [design for design in bad if design.certificate.undecided and not design.unknown]
    if any(not (one.certificate.far or one.certificate.unseen or one.certificate.resonance) for one in open_):
        steps += (f"measure longer: {longer}",)
    resonant: dict[str, list[str]] = {}
    for one in open_:
        if one.certificate.resonance:
            resonant.setdefault(f"{one.certificate.resonance:.2g} Hz", []).append(one.name)
    steps += tuple(
        f"find out what resonates near {where}, or choose less gain there than {', '.join(names)}"
        for where, names in resonant.items()
    )
    far = [one.name for one in open_ if one.certificate.far]
    if far:
        nothing = f"measuring longer decides nothing about {', '.join(far)}: the error would have to be a tenth at most"
        steps += (f"{nothing}; identify the hardware, and design with more margin",)
    if len(rejected) == count:
        steps += ("certify a design that the model stabilises: --design",)
    if slow:
        steps += (f"measure from lower frequencies: {longer} --signal-period {math.ceil(1.0 / min(slow))}",)
    return LayerResult(
        Layer.WHICH_CONTROLLERS,
        mark,
        f"Certified for the hardware: {verdict}; {limit}. It presumes as many unstable poles as the model has, "
        f"{unstable}, and no resonance between two frequencies that is damped by less than "
        f"{math.ceil(1e3 * damping) / 10.0:g} %; torque limits and friction at rest are outside it.",
        tuple(evidence),
        steps,
        limit if mark is Mark.YES else f"{_named(bad or rejected, count)} not certified for the hardware",
        f"{limit}; {', '.join(d.name for d in good)} certified to be stable there, which does not show how "
        "closely it moves as simulated"
        if good
        else "",
    )


def _named(some: Sequence[DesignResult], count: int) -> str:
    """Return a few designs by name, or the number of many."""
    return ", ".join(one.name for one in some) if len(some) <= _FEW else f"{len(some)} of {count} designs"


def _row(design: DesignResult, limit: float) -> Evidence:
    found = design.certificate
    if design.unknown:
        return Evidence(
            f"margin b(P, K), {design.name}", "", None, mark=Mark.UNDECIDED, note=f"unknown: {design.unknown}"
        )
    if not found.stable_on_model:
        how = "does not stabilise the model, sampled as the hardware is"
    elif found.unseen and found.undecided:
        how = (
            f"the model has poles below the lowest frequency, and the loop a mode at {found.unseen:.2g} Hz: what moves "
            "these poles cannot be seen"
        )
    elif found.resonance and found.undecided:
        how = f"what the lines near {found.resonance:.2g} Hz show may be a resonance that tips this loop"
    elif found.by_gap:
        how = "certified by its margin"
    elif found.by_frequency:
        how = f"certified frequency by frequency (loop distance {found.distance:.2f}, at {found.at:.2g} Hz)"
    elif found.undecided:
        how = f"loop distance {found.distance:.2f} at {found.at:.2g} Hz with the measurement's error, below 1 without"
    else:
        how = f"loop distance {found.distance:.2f} at {found.at:.2g} Hz; expected below 1"
    return Evidence(
        f"margin b(P, K), {design.name}",
        "",
        found.margin,
        None,
        None,
        f"above {limit:.3f}",
        Mark.YES if found.certified else Mark.UNDECIDED if found.undecided else Mark.NO,
        how,
    )
