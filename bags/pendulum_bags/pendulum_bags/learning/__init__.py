"""Training of policies for a plant, with what makes them hold on a machine."""
