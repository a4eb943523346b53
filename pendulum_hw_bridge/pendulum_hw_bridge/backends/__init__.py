"""Backends of the actuator port; each is one module and one line in :data:`pendulum_hw_bridge.backends.BACKENDS`."""

BACKENDS = {
    "emulator": "pendulum_hw_bridge.backends.emulator:EmulatorBackend",
    "emulator_process": "pendulum_hw_bridge.backends.emulator_process:EmulatorProcessBackend",
    "hebi": "pendulum_hw_bridge.backends.hebi:HebiBackend",
    "replay": "pendulum_hw_bridge.backends.replay:ReplayBackend",
}
"""Backend name -> ``module:class``."""
