"""Mapping of torque to setpoints, and checks of the drive's feedback."""
