"""The study `calibration`."""
