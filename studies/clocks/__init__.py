"""The study `clocks`."""
