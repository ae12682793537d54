"""The study `population`."""
