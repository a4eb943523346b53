"""Studies: many runs from one file, resumed where they stopped, and what they say together."""
