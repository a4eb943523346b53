"""Loops that run compiled: what they are made of, and how they are compiled, cached and loaded."""
