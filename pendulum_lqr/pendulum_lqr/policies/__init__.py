"""Learned policies: definition, files, and import from other libraries."""
