"""A recording as arrays: bags, CSV and JSON logs, and the folder of a run."""
