"""The programs of a lab: zero, sign, tare and proofs; module files, scans, the emulator."""
