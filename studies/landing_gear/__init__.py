"""The study `landing-gear`."""
