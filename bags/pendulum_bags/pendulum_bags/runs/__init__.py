"""A recording as arrays of one plant, and the folder of a run."""
