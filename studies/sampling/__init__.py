"""The study `sampling`."""
