"""Studies: many runs from one file, resumed where they stopped, and their pooled results."""
