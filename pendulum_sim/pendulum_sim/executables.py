"""The programs of this package, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "simulator": "pendulum_sim.simulator.simulator_node:main",
    "mujoco": "pendulum_sim.simulator.mujoco_node:main",
    "fmu": "pendulum_sim.simulator.fmu_node:main",
    "gymnasium": "pendulum_sim.simulator.gymnasium_node:main",
    "adopt": "pendulum_sim.simulator.adopt_node:main",
    "viewer": "pendulum_sim.pictures.viewer_node:main",
    "markers": "pendulum_sim.pictures.markers_node:main",
    "phase_plot": "pendulum_sim.pictures.phase_plot:main",
    "export_model": "pendulum_sim.exports.model_files:main",
}
