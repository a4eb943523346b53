"""A course in six exercises: hidden plants from a seed, and checks that say right or wrong."""
