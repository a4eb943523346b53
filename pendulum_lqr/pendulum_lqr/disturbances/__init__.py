"""Disturbance torques, compiled and interpreted, and their node."""
