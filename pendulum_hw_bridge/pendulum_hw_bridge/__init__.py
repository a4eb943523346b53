"""The real pendulum behind the simulator's interface: actuator port, backends, safety, and the bridge node over them."""

__version__ = "0.1.0"
