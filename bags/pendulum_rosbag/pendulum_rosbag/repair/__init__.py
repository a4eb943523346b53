"""Bags that another recorder left broken, made sound."""
