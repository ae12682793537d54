"""From parameters to a periodic equilibrium state."""
