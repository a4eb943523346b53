"""Figures, each drawn once: to a file and to a page."""
