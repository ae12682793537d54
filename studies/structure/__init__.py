"""The study `structure`."""
