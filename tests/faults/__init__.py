"""Attacks on the running system, in the short form; the long one, and what both use, is ``tests/tools/faults``."""
