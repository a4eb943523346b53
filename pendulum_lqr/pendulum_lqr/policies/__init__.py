"""Learned policies: what they are, their files, and what other libraries trained."""
