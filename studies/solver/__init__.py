"""The study `solver`."""
