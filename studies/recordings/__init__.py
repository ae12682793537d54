"""The study `recordings`."""
