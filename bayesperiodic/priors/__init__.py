"""Prior distributions of parameters."""
