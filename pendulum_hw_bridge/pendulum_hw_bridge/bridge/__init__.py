"""Bridge between the supervisor of a plant and its modules, with its parameters."""
