"""The study `elements`."""
