"""What controllers have in common: interface, tables of names, velocities, rates, and what a policy answers."""
