"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "simulator": "pendulum_sim.simulator_node:main",
    "mujoco": "pendulum_sim.mujoco_node:main",
    "gymnasium": "pendulum_sim.gymnasium_node:main",
    "adopt": "pendulum_sim.adopt_node:main",
    "viewer": "pendulum_sim.viewer_node:main",
    "markers": "pendulum_sim.markers_node:main",
    "phase_plot": "pendulum_sim.phase_plot:main",
    "export_model": "pendulum_sim.model_files:main",
}
