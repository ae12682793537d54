"""The study `animations`."""
