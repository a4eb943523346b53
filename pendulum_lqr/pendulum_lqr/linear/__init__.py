"""Linear theory: models, optimal gains in continuous and sampled time, margins, observers, regions of attraction."""
