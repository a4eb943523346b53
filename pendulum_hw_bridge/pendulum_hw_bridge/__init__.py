"""Hardware bridge: a HEBI X5-9, or its emulator, behind the same interface as the simulator."""
