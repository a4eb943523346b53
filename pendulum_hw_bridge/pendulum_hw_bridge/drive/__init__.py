"""How a torque becomes a setpoint, and what of a drive's feedback is believed."""
