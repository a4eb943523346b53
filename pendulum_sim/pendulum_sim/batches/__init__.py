"""Many plants at once, compiled."""
