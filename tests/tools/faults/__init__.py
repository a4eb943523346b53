"""Attacks on the running system, counted: ``make faults`` (``run``) tries them all and prints a table."""
