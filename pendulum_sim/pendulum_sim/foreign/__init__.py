"""Third-party simulations as plants."""
