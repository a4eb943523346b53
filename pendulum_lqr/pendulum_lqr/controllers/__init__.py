"""Controllers, one file each; ``pendulum_lqr.controller.CONTROLLERS`` names them."""
