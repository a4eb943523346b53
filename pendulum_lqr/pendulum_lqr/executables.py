"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "controller": "pendulum_lqr.nodes.controller_node:main",
    "disturbance": "pendulum_lqr.disturbances.disturbance_node:main",
    "effort_adapter": "pendulum_lqr.nodes.effort_adapter_node:main",
    "trajectory_action": "pendulum_lqr.nodes.trajectory_action_node:main",
    "design": "pendulum_lqr.design_command.design_cli:main",
    "swing_up": "pendulum_lqr.swing_up.swing_up_cli:main",
    "convert_policy": "pendulum_lqr.policies.convert_policy_cli:main",
}
