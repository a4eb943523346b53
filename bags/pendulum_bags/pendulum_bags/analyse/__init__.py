"""The same questions to every bag below a folder."""
