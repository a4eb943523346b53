"""Disturbance torques and their node."""
