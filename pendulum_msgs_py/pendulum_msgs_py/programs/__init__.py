"""Programs: their table, their ends, terminal, completion, and permissions on the graph."""
