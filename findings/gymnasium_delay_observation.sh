#!/usr/bin/env bash
# Expected: until the delay is filled, DelayObservation repeats the first observation, the only one that exists.
# Happens: it gives zeros, also after each reset. For a pendulum that is no state: cosine and sine of its angle are
# both 0, and the angle that a controller takes from them is 0, upright, at rest.
# Seen with: gymnasium 1.4.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    gymnasium==1.4.0 numpy==2.2.6
env/bin/python - <<'PY'
import math

import gymnasium
import numpy as np
from gymnasium.wrappers import DelayObservation

environment = DelayObservation(gymnasium.make("Pendulum-v1"), delay=3)
rest = np.zeros(1, dtype=np.float32)
seen = [environment.reset(seed=1, options={"x_init": 0.1, "y_init": 0.1})[0]]
seen += [environment.step(rest)[0] for _ in range(4)]
again, _ = environment.reset()
for step, observation in enumerate(seen):
    norm = math.hypot(observation[0], observation[1])
    inside = observation in environment.observation_space
    print("step", step, observation, "cos^2 + sin^2 =", round(norm**2, 6), "inside the space:", inside)
assert [bool(observation.any()) for observation in seen] == [False, False, False, True, True]
assert not again.any()
assert seen[0] in environment.observation_space  # so no checker of spaces notices
PY
