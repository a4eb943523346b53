"""Bags made of bags: in another storage, of several, of a time span, of some topics."""
