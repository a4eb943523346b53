"""Settings of the property tests: no deadline, which on a busy machine measures the neighbours."""

from hypothesis import settings

settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")
