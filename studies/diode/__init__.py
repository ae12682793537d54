"""The study `damper`."""
