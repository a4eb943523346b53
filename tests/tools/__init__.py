"""Programs that tests and benchmarks share, each with a command line of its own."""
