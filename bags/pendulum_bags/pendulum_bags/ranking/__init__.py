"""Would the simulation have picked the right controller? Costs on both sides, their correlation, violations, regret."""
