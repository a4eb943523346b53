"""Simulations that somebody else wrote, as plants."""
