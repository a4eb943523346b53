"""Training of policies for a plant, with what makes them transfer to a machine."""

__version__ = "0.1.0"
