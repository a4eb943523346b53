"""The simulator's node: which simulation it runs, its compiled loop, and how a plant on the graph is adopted."""
