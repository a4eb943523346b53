"""Frequency responses of plants under feedback: estimation, comparison, and the layers of the verdict on them."""
