"""The study `benchmark`."""
