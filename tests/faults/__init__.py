"""Attacks on the running system, counted. ``make faults`` runs the long form and prints a table."""
