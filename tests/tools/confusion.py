"""What a verdict names of recordings of which one thing was spoiled, counted.

``python -m tests.tools.confusion --seeds 3`` prints, for each thing, how often it is named alone, how often another
one is, and how often none; ``--mechanisms`` does so for plants of several joints. Where a hint says what to write, it
is followed, and has to lead to a fit that is taken.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pendulum_testing.mechanism_recordings import MECHANISMS, joint_verdict
from pendulum_testing.spoiled_recordings import SPOILS, TAKEN, hinted, spoil, verdict

__all__ = ["main"]


def _one(case: tuple[str, int]) -> tuple[str, int, str, str]:
    name, seed = case
    if name in MECHANISMS:
        return (name, seed, *joint_verdict(name, seed))
    cause = SPOILS[name][0]
    with tempfile.TemporaryDirectory() as folder:
        try:
            spoiled, path = spoil(name, seed), Path(folder) / "run.csv"
            named, refused, said = verdict(spoiled, path)
            hint = hinted(spoiled, said[0]) if cause and said else None
            if hint is not None:
                options, rules = hint
                again = verdict(replace(spoiled, options=options), path, rules)
                if again[1] or again[0] - {"wrap"}:
                    return name, seed, "hint fails", f"{said[0]} -> {again[2][0]}"
        except Exception as error:  # noqa: BLE001
            return name, seed, "crashed", f"{type(error).__name__}: {error}"
    wanted = {cause} if cause else set()
    if named == wanted and refused == (name not in TAKEN):
        return name, seed, "named" if cause else "accepted", said[0] if said else ""
    return name, seed, " ".join(sorted(named)) or ("refused" if refused else "accepted"), said[0] if said else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and each recording of which another thing or none was named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="recordings of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--spoils", nargs="*", help="kinds; by default all")
    parser.add_argument("--mechanisms", action="store_true", help="of several joints")
    given = parser.parse_args(arguments)
    causes = {name: words for name, (_, words, _) in MECHANISMS.items()} if given.mechanisms else {}
    causes = causes or {name: cause for name, (cause, _) in SPOILS.items()}
    given.spoils = given.spoils or list(causes)
    cases = [(name, seed) for seed in range(given.first, given.first + given.seeds) for name in given.spoils]
    found: dict[str, list[str]] = {name: [] for name in given.spoils}
    right = 0
    with multiprocessing.get_context("spawn").Pool(os.cpu_count()) as pool:
        for name, seed, named, said in pool.imap_unordered(_one, cases):
            found[name].append(named)
            if named in {"named", "accepted"} and (named == "named") == (causes[name] is not None):
                right += 1
            else:
                print(f"{name} {seed}: {named}: {said}", flush=True)
    width = max(len(cause or "") for cause in causes.values())
    print(f"{'spoiled':24}{'expected':{width}}  found")
    for name, all_named in found.items():
        counts = ", ".join(f"{one} {all_named.count(one)}" for one in dict.fromkeys(all_named))
        print(f"{name:24}{causes[name] or '-':{width}}  {counts}")
    print(f"{right} of {len(cases)} as expected")
    return 0 if right == len(cases) else 1


if __name__ == "__main__":
    raise SystemExit(main())
