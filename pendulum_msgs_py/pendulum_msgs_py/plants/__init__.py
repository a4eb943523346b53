"""Plants as files: parameters with units, and the presets."""
