"""Batches on a GPU: numba's simulator of one runs the kernels in a process of its own, and a GPU where there is one."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from numba import cuda

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.batches.batch import simulate_batch

SCRIPT = """
import dataclasses, json, sys
import numpy as np
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_sim.batches import cuda_kernels
from pendulum_sim.batches.batch import simulate_batch

cuda_kernels._PART = 3  # three parts, the last one not full; one plant alone would be other code
steps = int(sys.argv[1])
full = load_plant("dfki").with_values(
    static_friction=0.12, load_friction=0.02, actuator_time_constant=0.003, transport_delay=0.0033, effort_limit=20.0
)
acrobot = load_mechanism("acrobot").with_values({"elbow.transport_delay": 0.003, "elbow.time_constant": 0.004})
common = {"seeds": np.arange(8), "hold": 3, "record": True}
batches = {
    "link": lambda device: simulate_batch(
        load_plant("thesis"), variations={"inertia": np.linspace(0.05, 0.06, 8)}, steps=steps, method="etd2",
        gain=(33.3, 0.16), amplitude=2.5, device=device, **common,
    ),
    "dry link": lambda device: simulate_batch(
        [full, *(full.with_values(transport_delay=0.002 * k) for k in range(7))], steps=steps, method="etd2",
        position=3.4, gain=(6.0, 0.6), amplitude=2.5, substeps=2, device=device, **common,
    ),
    "joints": lambda device: simulate_batch(
        load_mechanism("double_pendulum_frictionless"), variations={"mass_2": np.linspace(0.6, 0.65, 8)}, steps=steps,
        gain=[[30.0, 5.0, 5.0, 1.0], [4.0, 20.0, 1.0, 3.0]], amplitude=(0.5, 0.25), device=device, **common,
    ),
    "dry joints": lambda device: simulate_batch(
        acrobot, steps=steps, gain=[[-295.0, -124.0, -63.0, -28.5]], amplitude=0.5, device=device, **common
    ),
}
differences = {}
for name in sys.argv[2:] or batches:
    run = batches[name]
    cpu, gpu = run("cpu"), run("cuda")
    values = [(getattr(cpu, field.name), getattr(gpu, field.name)) for field in dataclasses.fields(cpu)]
    assert all(np.ptp(own) > 0.0 for own, _ in values), name
    differences[name] = max(float(np.abs(own - other).max()) for own, other in values)
print(json.dumps(differences))
"""


# Each of the loops is compiled twice. The simulator runs each kind of loop and each kind of plant once, a GPU all four.
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "simulated",
    [True, pytest.param(False, marks=pytest.mark.skipif(not cuda.is_available(), reason="there is no CUDA GPU here"))],
)
def test_plants_on_a_gpu_move_as_on_the_processor(simulated: bool) -> None:
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1" if simulated else "0"}
    # The simulator interprets each step; a dozen last longer than any delay here.
    arguments = ("12", "dry link", "joints") if simulated else ("60",)
    command = [sys.executable, "-c", SCRIPT, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    differences = json.loads(done.stdout)
    assert len(differences) == (2 if simulated else 4)
    assert max(differences.values()) < 1e-9, differences


def test_without_a_gpu_one_sentence_says_so_and_auto_takes_the_processor() -> None:
    script = (
        "import numpy as np\n"
        "from pendulum_msgs_py.plants.plant_parameters import load_plant\n"
        "from pendulum_sim.batches.batch import simulate_batch\n"
        "run = lambda device: simulate_batch(load_plant('thesis'), steps=5, seeds=1, amplitude=2.5, device=device)\n"
        "assert run('auto').position == run('cpu').position\n"
        "run('cuda')\n"
    )
    environment = {**os.environ, "NUMBA_DISABLE_CUDA": "1", "NUMBA_ENABLE_CUDASIM": "0"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1
    assert "FaultError: device is 'cuda', but numba finds no GPU here: " in last
    assert "CUDA is disabled" in last
    assert last.endswith("expected an NVIDIA driver and pendulum_sim[cuda], or device cpu")


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ParameterError, match="device is 'gpu'; expected one of cpu, cuda, auto"):
        simulate_batch(load_plant("thesis"), steps=5, device="gpu")
