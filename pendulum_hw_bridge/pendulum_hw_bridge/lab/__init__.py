"""Programs for the lab: zero, sign, tare and proofs; module files, scans, the emulator."""
