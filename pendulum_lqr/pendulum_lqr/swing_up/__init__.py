"""Far from upright: planned and stored swing-ups of one joint and of several, who follows them and who catches."""
