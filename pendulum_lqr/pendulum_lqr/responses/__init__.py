"""Frequency responses: of controllers, of measured machines, and what they certify."""
