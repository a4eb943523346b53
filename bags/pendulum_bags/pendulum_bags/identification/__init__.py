"""Identification: from recordings to parameters that predict."""
