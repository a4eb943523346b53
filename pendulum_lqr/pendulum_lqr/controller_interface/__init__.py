"""What all controllers have: interface, tables of names, velocities, rates, laws as functions, a policy's answers."""
