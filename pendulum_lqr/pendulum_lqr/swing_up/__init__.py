"""Far from upright: planned and stored swing-ups of one joint and of several, tracking, and handover to an LQR."""
