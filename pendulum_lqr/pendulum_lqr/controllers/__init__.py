"""Controllers, one file each; ``pendulum_lqr.controller_interface.controller.CONTROLLERS`` names them."""
