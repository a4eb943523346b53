"""The plant as mathematics: models, integrators, sensors, batch engine; and the simulator node over them."""
