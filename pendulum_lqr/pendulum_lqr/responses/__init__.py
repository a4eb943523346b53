"""Frequency responses of controllers and measured machines, and certificates from them."""
