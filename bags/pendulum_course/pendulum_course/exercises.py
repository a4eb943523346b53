"""The exercises of a course as text, with the numbers of its seed, and their solutions."""

from __future__ import annotations

from pendulum_course.checks import WEIGHTS, critical_delay, noise_ratio, time_constant
from pendulum_course.tasks import CAUSES, FAULTS, Tasks
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, PlantParameters

__all__ = ["answers", "exercises_text"]

_TEXT = """\
# Six exercises

Work in the project's folder. Run `make extras` once, and activate the environment in each terminal:
`. .venv/bin/activate`. Each exercise ends with a command that says *right* or *wrong*; the answer in it is a
placeholder for yours. Background and hints: `bags/pendulum_bags/docs/tutorial.md`.

## 1. Choose Q and R
The plant is `thesis`. Choose Q and R of an LQR so that the time constant of the closed loop is
**{time_constant:g} s** (within 5 %).

    python -m pendulum_lqr design --preset thesis --q 100,0.01 --r 0.1
    python -m pendulum_course course check gains --q 100,0.01 --r 0.1 --course {course}

## 2. Identify an unknown pendulum
`{course}/hidden.yaml` is a sealed plant: the simulator runs it, and no other program reads it. It resembles `dfki`.
Design an excitation, play it on the hidden plant, and identify the parameters: inertia and gravity within 3 %,
damping and Coulomb friction within 15 %. SECONDS and ANGLE are for you to choose: `excite` predicts the half width of
each parameter's interval before it plays.

    python -m pendulum_bags excite --plant dfki --duration SECONDS --max-angle ANGLE --out {course}/try.csv \\
        --play --simulate {course}/hidden.yaml
    python -m pendulum_bags identify {course}/try --out {course}/found.yaml
    python -m pendulum_course course check plant {course}/found.yaml --course {course}

## 3. Find the delay at which it falls
Plant `thesis`, LQR with Q = diag({q[0]:g}, {q[1]:g}) and R = **{delay_weight:g}**, sampled at 100 Hz. How
long a delay of the torque makes the loop unstable (within 5 %)?

    python -m pendulum_lqr design --preset thesis --q {q[0]:g},{q[1]:g} --r {delay_weight:g}
    python -m pendulum_course course check delay SECONDS --course {course}

## 4. Explain why noise at 500 Hz looks calmer
The thesis's simulation gets new noise every 2 ms. Hold the noise for **{hold_ms:g} ms** instead, with the same loop
(plant `thesis`, Q = diag(100, 0.01), R = 0.1) and the same amplitude. By what factor does the standard deviation of
theta grow (within 20 %)? And why?

{causes}

    python -m pendulum_bags experiment lockstep --bag {course}/noise/short --hold-time 0.002 --duration 60
    python -m pendulum_bags experiment lockstep --bag {course}/noise/long --hold-time {hold_s:g} --duration 60
    python -m pendulum_bags analyse {course}/noise --ask metrics
    python -m pendulum_course course check noise FACTOR --because LETTER --course {course}

## 5. Predict the winner
Two LQRs for the plant `thesis`, both with Q = diag({q[0]:g}, {q[1]:g}): **A** with R = {controller_a:g}, **B** with
R = {controller_b:g}. In simulation the smaller R wins. Which of them leaves the smaller standard deviation of theta *on
the machine*, at 100 Hz, under noise of 2.5 N m? Predict before you measure: WHICH is a or b. The check runs both
on the emulated machine.

    python -m pendulum_course course check winner WHICH --course {course}

## 6. Break the bridge, safely
Arm the bridge on an emulated actuator, record it, and make it fault for the reason **`{fault}`**. The recording must
show that the bridge was armed, that it gave this reason, and that no torque acted from 60 ms after the fault on. Use
the emulator and nothing else. Give each line a terminal of its own, in this order; start the last one while the
pendulum moves. NAME is for you to find: `python -m pendulum_hw_bridge emulator_fault` lists what can fail.

    python -m pendulum_hw_bridge emulator
    python -m pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p backend:=emulator_process -p feedback_watchdog:=20
    python -m pendulum_bags record -o {course}/broken /hw/joint_states /hw/applied_effort /hw/events
    python -m pendulum_bags move upright --namespace /hw
    python -m pendulum_hw_bridge emulator_fault NAME

End the recording with Ctrl-C, a second or more after the fault.

    python -m pendulum_course course check fault {course}/broken --course {course}
"""


def exercises_text(tasks: Tasks, course: str) -> str:
    """Return the exercises as Markdown; ``course`` is the course's folder, for the commands."""
    causes = "\n".join(f"- **{letter}**: {CAUSES[name]}" for letter, name in zip("abcd", tasks.causes, strict=True))
    return _TEXT.format(
        time_constant=tasks.time_constant,
        delay_weight=tasks.delay_weight,
        hold_ms=1e3 * tasks.hold_time,
        hold_s=tasks.hold_time,
        causes=causes,
        controller_a=tasks.controller_a,
        controller_b=tasks.controller_b,
        fault=tasks.fault,
        q=WEIGHTS,
        course=course,
    )


def answers(tasks: Tasks, plant: PlantParameters) -> dict[str, str]:
    """Return the solution of each exercise as text, for the teacher."""
    units = {spec.name: spec.unit for spec in PLANT_SPECS}
    named = ("inertia", "damping", "gravity", "coulomb_friction")
    winner = "a" if tasks.controller_a > tasks.controller_b else "b"
    letter = "abcd"[tasks.causes.index("power")]
    return {
        "1 gains": f"--q {WEIGHTS[0]:g},{WEIGHTS[1]:g} --r {_weight_for(tasks.time_constant):.3g} (one of many)",
        "2 plant": ", ".join(f"{name} {getattr(plant, name):.4g} {units[name]}" for name in named),
        "3 delay": f"{critical_delay(tasks):.3g} s",
        "4 noise": f"{noise_ratio(tasks):.3g}, because {letter}: {CAUSES['power']}",
        "5 winner": f"{winner}, the larger R: the other one is too quick for the machine's delay, and swings or faults",
        "6 fault": f"emulator_fault {FAULTS[tasks.fault]}",
    }


def _weight_for(wanted: float) -> float:
    """Return the R with which the thesis's Q gives a time constant [s]; it grows with R."""
    low, high = -7.0, 5.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if time_constant(WEIGHTS, 10.0**middle) < wanted else (low, middle)
    return float(10.0 ** (0.5 * (low + high)))
