"""The same questions asked of every bag below a folder."""
