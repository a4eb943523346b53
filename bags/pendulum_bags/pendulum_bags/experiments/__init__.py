"""Experiments: programs started, conducted over DDS, recorded, compared and always put back to rest."""
