"""The actuator port: what the bridge asks of any drive, its settings, and its clocks."""
