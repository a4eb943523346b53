"""Programs: their table, their ends, terminal, completion, and who may speak on the graph."""
