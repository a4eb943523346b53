"""Common parts of controllers: interface, table of names, velocity estimates, rates, laws as functions, policies."""
