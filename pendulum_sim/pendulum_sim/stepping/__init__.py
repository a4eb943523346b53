"""Plants as they are stepped: integrators, friction, springs, sensors, position control."""
