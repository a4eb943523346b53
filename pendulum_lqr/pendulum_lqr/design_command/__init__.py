"""The command ``design``: its tables and figures."""
