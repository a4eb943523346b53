"""A course in six exercises: hidden plants from a seed, and checks of the results."""

__version__ = "0.1.0"
