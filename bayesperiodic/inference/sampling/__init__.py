"""Draws from the posterior, and how far to trust them."""
