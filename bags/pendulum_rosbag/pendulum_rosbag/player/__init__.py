"""Bags published again, with their clock."""
