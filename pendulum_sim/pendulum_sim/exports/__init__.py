"""Plants as URDF and MJCF."""
