"""The verdict in frequency, on plants whose difference is known: certificates, power and false alarms, ranking."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits

from pendulum_bags.experiments.in_process import simulate_plant
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.frequency_response.compare import Difference, compare_responses
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.layers import GAP_MARGIN, same_plant
from pendulum_bags.frequency_response.record import record_of_arrays
from pendulum_bags.verdict import Mark
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import DiscreteModel, discretise
from pendulum_lqr.responses.certificate import Certificate, Certifier, is_stable
from pendulum_lqr.responses.gap_metric import DEFAULT_SCALING, nu_gap
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_lqr.responses.sampled_response import model_response
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.stepping.sensors import Sensors
from pendulum_testing.plant_pairs import K as THESIS_GAIN
from tests.benchmarks import Row, counted, measured

PAIRS, GAINS = 50, 1000
AT_MARGIN = 300
"""Trials of what lies on the margin of a layer: 15 false answers of 300 are 5 %."""
TRIALS = 100
"""Trials of each difference that must be found, and of none."""
PERIOD = 0.01
EXCITATION = {
    "kind": "multisine",
    "signal_period": 4.0,
    "frequency": 0.25,
    "frequency_end": 47.5,
    "lines": 48,
    "hold_time": 0.01,
}
"""That of ``experiment frequency_response``."""
SENSORS = {"position_step": 1e-5, "velocity_noise": 5e-4}
"""Those of the emulated X5-9."""
FRICTION = load_plant("thesis").with_values(coulomb_friction=0.1, static_friction=0.1)
"""The thesis's plant with dry friction, for differences of friction."""


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    # Matrices are small: threads of the linear algebra would only get into each other's way.
    with threadpool_limits(1):
        yield from certificate_rows()
        yield from certificate_margin_rows()
        yield from power_rows()
        yield from margin_rows()
    yield from ranking_rows()


def measure(
    plant: PlantParameters,
    *,
    side: str = "hw",
    seed: int = 1,
    design: str = "thesis",
    amplitude: float = 2.5,
    periods: int = 8,
    gains: dict[str, Any] | None = None,
) -> MeasuredResponse:
    """Measure a plant as a default run does: 8 periods after one that settles."""
    spec = RunSpec(
        side=side,
        design_plant=design,
        controller_parameters=gains or {},
        disturbance={**EXCITATION, "amplitude": amplitude},
        duration=4.0 * (periods + 1),
        seed=1 + seed % 7,
        method="etd4",
    )
    sensors = Sensors(np.random.default_rng(2 * seed + (side == "sim")), **SENSORS)
    return estimate(record_of_arrays(simulate_plant(spec, plant, sensors), side, spec.disturbance_parameters()))


# --- certificates
# ------------------------------------------------------------------------------------------------------


@dataclass
class Counts:
    """What became of the gains."""

    stable: int = 0
    good: int = 0
    certified: int = 0
    by_gap: int = 0
    good_certified: int = 0
    good_by_gap: int = 0
    failed: int = 0


def certify_pairs(pairs: Iterable[int] = range(PAIRS), gains: int = GAINS) -> Counts:
    """Certify random gains on measured machines whose gain, friction, weight, lag and delay the model does not know."""
    counts = Counts()
    for number in pairs:
        generator = np.random.default_rng([11, number])
        preset, weights, amplitude = (("thesis", {}, 2.5), ("dfki", {"q": [100.0, 1.0], "r": 1.0}, 1.2))[number % 2]
        base = load_plant(preset).with_values(coulomb_friction=0.0, static_friction=0.0, effort_limit=13.0)
        machine = _other(base, generator)
        found = measure(machine, seed=number, design=preset, amplitude=amplitude, gains=weights)
        nominal, true = linearise(base), linearise(machine)
        sampled = discretise(true, PERIOD)
        certifier = Certifier(nominal, Machine.of(found))
        loops = model_response(true, np.concatenate([[0.0], np.geomspace(1e-3, 49.999, 1500)]), PERIOD)
        for _ in range(gains):
            K = np.array([base.gravity, 1.0]) * np.exp([generator.uniform(-0.2, 4.0), generator.uniform(-4.0, 2.0)])
            _count(counts, certifier, sampled, K, loops)
    return counts


def _other(base: PlantParameters, generator: np.random.Generator) -> PlantParameters:
    gain = generator.uniform(0.8, 1.25)
    return base.with_values(
        inertia=base.inertia / gain * generator.uniform(0.9, 1.1),
        damping=base.damping / gain * generator.uniform(0.5, 2.0),
        gravity=base.gravity / gain * generator.uniform(0.9, 1.1),
        transport_delay=generator.uniform(0.0, 0.012),
        actuator_time_constant=generator.uniform(0.0, 0.005),
    )


def _count(
    counts: Counts,
    certifier: Certifier,
    true: DiscreteModel,
    K: NDArray[np.float64],
    loops: NDArray[np.complex128],
) -> None:
    certificate = certifier.gain(K)
    stable = is_stable(true, K)
    good = stable and _good(true, K, loops)
    counts.stable += stable
    counts.good += good
    counts.certified += certificate.certified
    counts.by_gap += certificate.by_gap
    counts.good_certified += good and certificate.certified
    counts.good_by_gap += good and certificate.by_gap
    counts.failed += certificate.certified and not stable


def _good(true: DiscreteModel, K: NDArray[np.float64], loops: NDArray[np.complex128]) -> bool:
    """Tell whether a gain keeps 6 dB both ways and 30 degrees on the machine."""
    if not all(is_stable(true, K * factor) for factor in (2.0, 0.5)):
        return False
    loop = K @ loops
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))
    return all(np.degrees(abs(np.angle(-loop[i]))) >= 30.0 for i in crossings)


def certificate_rows() -> Iterator[Row]:
    """Yield what the certificates are worth."""
    counts = certify_pairs()
    what = f"{GAINS} random gains on {PAIRS} measured machines"
    yield measured(
        f"{what}: certified gains that do not stabilise the machine",
        counts.failed,
        "gains",
        at_most=0.0,
        note=f"{counts.certified} certified of {counts.stable} that stabilise",
    )
    yield counted(
        f"{what}: certified, of those that stabilise with 6 dB and 30 degrees",
        counts.good_certified,
        counts.good,
        at_least=50.0,
        note=f"by the gap alone {100.0 * counts.good_by_gap / counts.good:.1f} %",
    )


def certificate_margin_rows(trials: int = AT_MARGIN) -> Iterator[Row]:
    """Yield how often designs are certified that a measurement without noise would just not certify.

    One has exactly the margin b(P, K) of the gap, one exactly the loop distance 1, and one is where the machine's loop
    loses its stability.
    """
    base = load_plant("thesis")
    machine = base.with_values(transport_delay=0.03)
    nominal, true = linearise(base), linearise(machine)
    measured_once = measure(machine, seed=1)
    exact = replace(
        measured_once,
        response=model_response(true, measured_once.frequency, PERIOD),
        deviation=1e-9 * measured_once.deviation,
    )
    certifier = Certifier(nominal, Machine.of(exact))
    thesis = np.array(THESIS_GAIN)

    def at(function: Callable[[Certificate], float], low: float, high: float) -> float:
        return float(brentq(lambda factor: function(certifier.gain(factor * thesis)), low, high, xtol=1e-9))

    limit = certifier.profile.value_upper
    by_gap = at(lambda found: found.margin - limit, 1.0, 20.0)
    by_distance = at(lambda found: found.distance - 1.0, 1.0, 20.0)
    sampled = discretise(true, PERIOD)
    unstable = next(factor for factor in np.geomspace(1.0, 100.0, 20_001) if not is_stable(sampled, factor * thesis))
    cases = (
        ("its margin b is the gap", by_gap, lambda found: found.by_gap),
        ("its loop distance is 1", by_distance, lambda found: found.by_frequency),
        ("the machine's loop is at the limit of stability", unstable, lambda found: found.certified),
    )
    counts = [0, 0, 0]
    for seed in range(trials):
        found = Certifier(nominal, Machine.of(measure(machine, seed=seed)))
        for i, (_, factor, certified) in enumerate(cases):
            counts[i] += bool(certified(found.gain(factor * thesis)))
    for (name, factor, _), count in zip(cases, counts, strict=True):
        yield counted(
            f"layer 3 at its margin: a gain is certified although {name}",
            count,
            trials,
            at_most=5.0,
            note=f"{factor:.3g} times the thesis's gain, 30 ms of delay that the model does not know",
        )


# --- power and false alarms
# --------------------------------------------------------------------------------------------


@cache
def _simulated(seed: int, *, friction: bool) -> MeasuredResponse:
    return measure(FRICTION if friction else load_plant("thesis"), side="sim", seed=seed)


def differences(machine: PlantParameters, trials: int = TRIALS, *, friction: bool = False) -> list[Difference]:
    """Return the differences that default runs find between the simulation and a machine."""
    model = linearise(load_plant("thesis"))
    return [
        compare_responses(_simulated(seed, friction=friction), measure(machine, seed=seed), model)
        for seed in range(trials)
    ]


def power_rows(trials: int = TRIALS) -> Iterator[Row]:
    """Yield how often a default run finds what is there, and what is not."""
    base = load_plant("thesis")
    weaker = {name: getattr(base, name) / 0.8 for name in ("inertia", "damping", "gravity")}
    cases = (
        ("a delay of 10 ms", base.with_values(transport_delay=0.01), False),
        ("20 % less gain", base.with_values(**weaker), False),
        ("twice the viscous friction", base.with_values(damping=2.0 * base.damping), False),
        (
            "twice the dry friction (0.1 N m)",
            FRICTION.with_values(coulomb_friction=0.2, static_friction=0.2),
            True,
        ),
    )
    for name, machine, friction in cases:
        found = differences(machine, trials, friction=friction)
        yield counted(
            f"frequency response, default run of 36 s: {name} is found",
            sum(one.found for one in found),
            trials,
            at_least=95.0,
            note=f"median delay {1e3 * _median(found, 'delay'):.2f} ms, gain {_median(found, 'gain'):.3f}, nu-gap "
            f"{_median(found, 'nu_gap'):.3f}",
        )
    for name, machine, friction in (("", base, False), (" with dry friction", FRICTION, True)):
        same = differences(machine, trials, friction=friction)
        what = f"frequency response, same plant{name} at 500 and 100 Hz, other noise"
        yield counted(f"{what}: a difference is found", sum(one.found for one in same), trials, at_most=5.0)
        yield counted(
            f"{what}: the layer says yes", sum(one.nu_gap.high < GAP_MARGIN for one in same), trials, at_least=95.0
        )


def _median(found: list[Difference], name: str) -> float:
    return float(np.median([getattr(one, name).value for one in found]))


def margin_rows(trials: int = AT_MARGIN) -> Iterator[Row]:
    """Yield how often the layer says yes to a machine whose true gap is the margin."""
    base = load_plant("thesis")
    frequency = estimate_lines()

    def machine(gain: float) -> PlantParameters:
        return base.with_values(**{name: getattr(base, name) / gain for name in ("inertia", "damping", "gravity")})

    def gap(gain: float) -> float:
        one, two = (
            DEFAULT_SCALING.plant(model_response(linearise(p), frequency, PERIOD)) for p in (base, machine(gain))
        )
        return nu_gap(one, two).value - GAP_MARGIN

    gain = float(brentq(gap, 1.05, 6.0))
    yes = 0
    for seed in range(trials):
        one, two = _simulated(seed, friction=False), measure(machine(gain), seed=seed)
        yes += same_plant(one, two, compare_responses(one, two, linearise(base))).mark is Mark.YES
    yield counted(
        f"layer 2 at its margin: a nu-gap of {GAP_MARGIN:g} ({gain:.2f} times the gain) is called the same plant",
        yes,
        trials,
        at_most=5.0,
    )


def estimate_lines() -> NDArray[np.float64]:
    """Return the frequencies of a default run [Hz]."""
    return measure(load_plant("thesis"), periods=3).frequency


# --- ranking
# -----------------------------------------------------------------------------------------------------------


def ranking_rows(seeds: int = 2) -> Iterator[Row]:
    """Yield the ranking of all controllers and twenty gains on the simulator and the emulated X5-9, over DDS."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "pendulum_bags",
            "experiment",
            "ranking",
            "--seeds",
            str(seeds),
            "--json",
        ]
        done = subprocess.run(
            [*command, "--out", str(Path(folder) / "ranking")],
            capture_output=True,
            text=True,
            timeout=3000,
            check=False,
        )
    if not done.stdout.strip():
        raise RuntimeError(done.stderr.strip()[-500:])
    found = json.loads(done.stdout)["ranking"]
    n = len(found["names"])
    srcc, mmrv, regret = found["srcc"], found["mmrv"], found["regret"]
    sure = [pair for pair in found["wrong"] if pair["sure"]]
    dearest = f"; {sure[0]['picked']} before {sure[0]['better']}: {sure[0]['reason']}" if sure else ""
    what = f"ranking of {n} controllers and gains on simulator and emulated X5-9"
    yield measured(f"{what}: SRCC", srcc["value"], "-", note=f"{srcc['low']:.3f} to {srcc['high']:.3f}")
    yield measured(
        f"{what}: MMRV",
        mmrv["value"],
        "cost",
        note=f"{mmrv['low']:.3g} to {mmrv['high']:.3g}; {len(found['wrong'])} of {found['pairs']} pairs in the wrong "
        f"order, {len(sure)} surely{dearest}",
    )
    yield measured(
        f"{what}: regret of the simulation's pick",
        # A pick that fails on the hardware costs more than any number.
        100.0 * (math.inf if regret["value"] is None else regret["value"] / found["hw"][0]),
        "% of the best",
        note=f"{_number(regret['low'])} to {_number(regret['high'])}; picks {found['pick']}, best is {found['best']}",
    )


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"
