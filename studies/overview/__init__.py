"""The study `overview`."""
