"""The emulated X5-9: physics, firmware, temperatures, faults, and the process that serves it."""
