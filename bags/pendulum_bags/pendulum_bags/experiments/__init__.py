"""Experiments: programs started, orchestrated over DDS, recorded, compared and always returned to rest."""
