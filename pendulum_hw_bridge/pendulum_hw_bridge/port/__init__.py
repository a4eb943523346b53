"""Actuator port: the interface of the bridge to any drive, its settings and clocks."""
