"""Controllers, one file each; ``pendulum_lqr.laws.controller.CONTROLLERS`` names them."""
