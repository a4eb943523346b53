"""Recordings that determine a pendulum and such that do not: what ``identify`` makes of each, counted.

``python -m tests.tools.undetermined --seeds 10`` prints the counts. The motions come from SciPy alone. A fit that is
taken counts as false where the truth lies outside of its interval, widened to twice and at least a quarter of the
value, or where the interval holds 0 or spans a factor of ten (but for the inertia of a strongly overdamped pendulum,
which decides nothing); a refusal of a good recording counts as false, too.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Sequence

import numpy as np

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Options
from pendulum_msgs_py.errors import PendulumError
from pendulum_testing.undetermined_recordings import BAD, GOOD, Trial, make

__all__ = ["judge"]


def judge(trial: Trial, options: Options = Options()) -> tuple[str, str]:  # noqa: B008
    """Return ``refused``, ``right`` or ``false``, and what there is to say of it."""
    try:
        result = identify([trial.recording], options)
    except PendulumError as error:
        return "refused", str(error)
    if result.refused:
        return "refused", result.verdict
    truth = {"inertia": trial.truth.inertia, "gravity": trial.truth.gravity}
    found = result.uncertainty.intervals
    if "inertia" not in found:
        # Ratios to the inertia alone.
        truth = {"gravity": trial.truth.gravity / trial.truth.inertia * result.model["inertia"]}
    wrong = []
    for name, value in truth.items():
        low, high = (found[name].low, found[name].high) if name in found else (-np.inf, np.inf)
        estimate = result.model[name]
        reach = max(2.0 * (high - estimate), 2.0 * (estimate - low), 0.25 * value)
        slow = name == "inertia" and trial.truth.damping > 4.0 * trial.truth.inertia * trial.truth.frequency
        if not abs(estimate - value) <= reach or ((low <= 0.0 or high > 10.0 * low) and not slow):
            wrong.append(f"{name} {estimate:.4g} ({low:.3g} to {high:.3g}), true {value:.4g}")
    return ("false", "; ".join(wrong)) if wrong else ("right", "")


def _one(case: tuple[str, int]) -> tuple[str, int, str, str]:
    name, seed = case
    kind = next(k for k in (*GOOD, *BAD) if k.__name__ == name)
    try:
        return (name, seed, *judge(make(kind, seed)))
    except Exception as error:  # noqa: BLE001
        return name, seed, "crashed", f"{type(error).__name__}: {error}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table of verdicts by kind, and each false one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="recordings of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--kinds", nargs="*", default=[k.__name__ for k in (*GOOD, *BAD)])
    parser.add_argument("--all", action="store_true", help="print every verdict")
    given = parser.parse_args(arguments)
    cases = [(kind, seed) for kind in given.kinds for seed in range(given.first, given.first + given.seeds)]
    good = {k.__name__ for k in GOOD}
    counts = {kind: dict.fromkeys(("right", "refused", "false", "crashed"), 0) for kind in given.kinds}
    with multiprocessing.get_context("spawn").Pool(os.cpu_count()) as pool:
        for kind, seed, verdict, words in pool.imap_unordered(_one, cases):
            counts[kind][verdict] += 1
            if given.all or verdict in {"false", "crashed"} or (kind in good and verdict == "refused"):
                print(f"{kind} {seed}: {verdict}: {words}", flush=True)
    print(f"{'kind':22}{'right':>9}{'refused':>9}{'false':>9}{'crashed':>9}")
    for kind, row in counts.items():
        print(f"{kind:22}" + "".join(f"{n:9}" for n in row.values()))
    accepted = sum(row["false"] + row["crashed"] for row in counts.values())
    refused = sum(counts[kind]["refused"] for kind in counts if kind in good)
    print(f"false acceptances {accepted}, false refusals {refused}, of {len(cases)} recordings")
    return 1 if accepted or refused else 0


if __name__ == "__main__":
    raise SystemExit(main())
